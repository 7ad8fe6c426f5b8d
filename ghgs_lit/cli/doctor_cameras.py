"""``ghgs doctor task=cameras``: whether photographs, masks and calibration fit together."""

import rich
from omegaconf import DictConfig
from rich.table import Table

from ghgs_lit.cli.photographs import capture_folder
from ghgs_lit.cli.runtime import announce, output_dir, save_config
from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.calibration import calibrate
from ghgs_lit.prediction.capture.camera_report import Diagnosis, Hypothesis, diagnose
from ghgs_lit.prediction.capture.drawing import camera_sheet
from ghgs_lit.prediction.capture.folder import CaptureFolder
from ghgs_lit.prediction.capture.formats.json_and_toml import write_json
from ghgs_lit.visualization.pictures import save_png

#: How many meanings are listed.
_LISTED = 6


def run(cfg: DictConfig) -> None:
    """Print what was found; write ``cameras.png``, and ``cameras.json`` of a meaning that fits. InputError:
    the cameras do not fit as they are."""
    tasks = "images=<folder of photographs> cameras=<calibration>, task=machine or task=selfcheck"
    require(cfg.images is not None, "images", tasks, None)
    directory = output_dir()
    folder = capture_folder(save_config(cfg, directory))
    inputs = {path.resolve() for path in folder.input_files}
    for path in (directory / "cameras.png", directory / "cameras.json"):
        require(
            path.resolve() not in inputs, str(path), "a folder (hydra.run.dir) without inputs", "an input"
        )
    diagnosis = diagnose(folder)
    _show(diagnosis)
    best = diagnosis.ranking[0]
    if best.score > 0:
        path = directory / "cameras.png"
        save_png(_sheet(folder, best), path)
        announce(path)
    if diagnosis.option:
        # A calibration that needs no option any more.
        path = directory / "cameras.json"
        views = {
            v.name: (calibrate(v.camera, v.convention, v.camera.size), v.camera.size) for v in best.views
        }
        write_json(path, views)
        announce(path)
    if not diagnosis.consistent:
        raise InputError(
            f"{cfg.cameras}: expected cameras that fit the masks; found {'; '.join(diagnosis.lines)}"
        )


def _show(diagnosis: Diagnosis) -> None:
    table = Table("meaning", "worst agreement", *diagnosis.ranking[0].shares)
    for hypothesis in diagnosis.ranking[:_LISTED]:
        shares = (f"{share:.0%}" for share in hypothesis.shares.values())
        table.add_row(hypothesis.says, f"{hypothesis.score:.0%}", *shares)
    rich.print(table)
    print("\n".join(diagnosis.lines), flush=True)


def _sheet(folder: CaptureFolder, hypothesis: Hypothesis):
    views = hypothesis.views
    images = [folder.photograph(v.name, v.camera, v.pixels, v.mask, v.convention).image for v in views]
    return camera_sheet([v.name for v in views], images, hypothesis.silhouettes(folder))
