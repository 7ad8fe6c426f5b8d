"""Rules for running the commands of documents: exclusions, settings and prepared files.

:mod:`scripts.check_documents` runs them.
"""

import importlib.util

PUBLISHED = "needs published weights"
NETWORK = "needs a package index"
# Pattern of the beginning of a command, and the reason for not running it.
NOT_RUN = [
    (r"make (?!demo$|bench$)", "sets up an environment, or is what continuous integration runs"),
    (r"\w+=\S+ make demo", NETWORK),
    (r"pip install", NETWORK),
    (r"git clone|python3 -m venv", "makes a checkout and its environment"),
    (r"source ", "the commands run in the environment of this script"),
    (r"ghgs import", PUBLISHED),
    (r"ghgs predict images=colmap", "needs a COLMAP project"),
    (r"ghgs \w+ checkpoint=release\.ckpt", PUBLISHED),
    (r"ghgs train (?!.*dry_run).*encoder=vggt_1b", PUBLISHED),
    (r"ghgs train .*hydra/launcher=slurm", "needs a cluster"),
    (r"bash scripts/slurm_drill", "needs SLURM"),
    (r"ghgs (train|evaluate|benchmark) .*split=bench", "renders forty people"),
    (r"ghgs table .*runs/ablation", "needs twelve runs"),
    (r"(GHGS_PLUGINS=\S+ )?ghgs (train|table) .*controls", "needs 21 runs"),
    (r"ghgs (train|table) .*runs/peers|ghgs evaluate .*train: 48", "needs 60 people, or runs of theirs"),
    (r"ghgs (train|export) .*runs/shipped", "renders 344 people"),
    (r"python scripts/mutate\.py", "runs the whole suite"),
    (r"python -m pytest -m gpu|python benchmarks/gpu\.py(?!.*--dry)", "needs a GPU and a checkout"),
    (r"ghgs evaluate .*per_scene", "fits Gaussians to each person, for minutes"),
    (r"ghgs stress$", "takes a quarter of an hour"),
    (r"python scripts/drill\.py", "trains twelve runs, killed ten times"),
    (r"SMPL_MODEL=…", "needs the licensed body model and both data sets"),
]
if importlib.util.find_spec("smplx") is None:
    NOT_RUN.append((r"ghgs .*data\.smpl_model=|SMPL_MODEL=/", "needs the package smplx"))

CPU = "encoder=vggt_nano optimizer=from_scratch trainer=cpu"
TINY = "data.people='{train: 2, val: 2}' data.size=56 data.render.samples=1 data.render_workers=0"
SHORT = "trainer.max_steps=2 trainer.val_check_interval=2 trainer.limit_val_batches=1"
FEW = "--size 128 --train 2 --val 1"
TRAIN = r"^((?:\w+=\S+ )?ghgs train (?!.*(?:dry_run|-help))"  # beginning of the pattern of a training command
# Pattern, replacement and reason.
SMALL = [
    (r"^make demo$", f"bash scripts/demo.sh {TINY} {SHORT}", "without the set-up, two steps"),
    (r"^bash scripts/demo\.sh$", f"bash scripts/demo.sh {TINY} {SHORT}", "two steps"),
    (r"\btrainer=gpu\b", "trainer=cpu", "no GPU"),
    (r"^make bench$", "python benchmarks/rasterizer.py", "without the set-up"),
    (r"^(ghgs benchmark (?!.*-help).*)", r"\1 timing.repeats=1 subjects=1", "one round"),
    (r"^(ghgs benchmark data=synthetic .*)", rf"\1 {TINY}", "two people of 56 x 56 pixels"),
    (r"refine=15", "refine=2", "two steps"),
    (r"^(ghgs predict .*)", r"\1 turntable.frames=2", "two pictures"),
    (r"images=videos (.*)masks=mask_videos", r"images=instants \1masks=instant_masks", "two instants"),
    (r"minutes=3", "minutes=1", "a minute"),
    (r"^(ghgs predict data=.*)", r"\1 data.size=112", "112 x 112 pixels"),
    (r"(?<==)/data/", "", "folders next to this one"),
    (r"data\.active\.train=\d+", "data.active.train=1", "one person"),
    (r"^(ghgs pretext .*)", rf"\1 {TINY} {SHORT}", "two people of 56 x 56 pixels, two steps"),
    (r"^(tensorboard .*)", r"timeout 20 \1 --port 0 || [ $? = 124 ]", "a server: stopped after 20 s"),
    (r" init_from=start\.ckpt", "", PUBLISHED),
    (r"^(ghgs view .*)", r"\1 seconds=1", "a server: stopped after 1 s"),
    (r"runs/train/<time>", "runs/train/$(ls runs/train | grep ^20 | tail -n 1)", "the last run"),
    (r"<run>", "runs/before", "a small run"),
    (r"<checkpoint>", "shipped", "the weights that come with the package"),
    (r"(?<=runs=runs/train/)(<sweep>|mine|models)", "paper", "a small sweep"),
    (r"(?<=data\.root=)\.\.\.", "zju", "a miniature"),
    (r"(?<=THuman2\.0_Release )data\.root=rendered", "data.root=rendered_scans", "next to the miniature"),
    (r"data\.render\.size=\d+", "data.render.size=56 data.render.samples=1 data.render_workers=0",
     "small photographs"),
    (r"^(ghgs prepare task=render(?!.*render\.size).*)", r"\1 data.render.size=56", "small photographs"),
    (r"^(.*miniature\.py.*)", rf"\1 {FEW}", "few people"),
    (r"^(python benchmarks/captures\.py.*?)(?: --first \d+)?$", r"\1 --people 1", "one person"),
    (r"^git show \S+/shipped\.ckpt > (\S+)", r"ghgs export checkpoint=shipped inference=\1", "new weights"),
    (r"^(ghgs train (?!.*dry_run).*sweep=table\d.*)", r"\1 dry_run=true", "needs a GPU: planned only"),
    (r"^(ghgs train .*sweep=table\d.*dry_run=true.*)", r"\1 || [ $? = 1 ]", "reports what it lacks here"),
    (r"(?<=seed=1,2),3(,4)?", "", "two seeds"),
    (TRAIN + r".*(?:experiment=(?:demo|shipped)|data=synthetic).*)", rf"\1 {TINY}",
     "two people of 56 x 56 pixels"),
    (TRAIN + r".*experiment=shipped.*)", r"\1 data.active.train=1 augmentation=none trainer=cpu", "small"),
    (TRAIN + r".*data.root=rendered.*)", r"\1 data.size=56", "56 x 56 pixels"),
    (TRAIN + r"(?!.*vggt_nano).*experiment=(?:thuman2|zju_mocap|humman).*)", rf"\1 {CPU}", "no GPU"),
    (TRAIN + r".*experiment=zju_mocap.*)", r"\1 data.size=112", "112 x 112 pixels"),
    (TRAIN + r".*)", rf"\1 {SHORT}", "two steps"),
]  # fmt: skip

_SCANS = "python scripts/miniature.py data=thuman2 data.source={} --size 64 --train 2"
_RENDER = "ghgs prepare task=render data=scans data.source={} data.root=rendered data.render.size=60"
_RENDERED = (_SCANS.format("scans"), _RENDER.format("scans"))
_RUN = f"ghgs train experiment=demo {TINY} {SHORT}"
_SWEEP = (
    f"ghgs train -m experiment=demo {TINY} {SHORT} ablation=full,neither 'evaluation.views=[4]' "
    "evaluation.pictures=0 logger=none callbacks=none hydra.sweep.dir=runs/train/paper"
)
_ABLATION = (
    "mkdir -p my_conf/ablation && "
    r"printf '# @package _global_\nrecalibration: {k: 1}\n' > my_conf/ablation/one_neighbor.yaml"
)
_CHECKPOINTS = (
    f"{_RUN} hydra.run.dir=runs/mine",
    *(f"cp runs/mine/checkpoints/last.ckpt {n}.ckpt" for n in "ab"),
)
# Photographs of static cameras from rendered scans, in the layout of docs/template.
_PHOTOGRAPHS = """python - <<'END'
from pathlib import Path
import numpy as np
from PIL import Image
for phase in ("train", "val"):
    root = Path("rendered", phase)
    for person in sorted(p.name[:-4] for p in (root / "img").glob("*_000")):
        folder = Path("photographs", phase, person)
        folder.mkdir(parents=True)
        names = [f"{person}_{position:03d}" for position in range(0, 16, 2)]
        for camera, name in enumerate(names):
            image = Image.open(root / "img" / name / "0.jpg")
            mask = Image.open(root / "mask" / name / "0.png").convert("L")
            image.putalpha(mask.point(lambda value: 255 * (value > 0)))
            image.save(folder / f"{camera}.png")
        cameras = {kind: [np.load(root / "parm" / name / f"0_{kind[:-1]}.npy") for name in names]
                   for kind in ("intrinsics", "extrinsics")}
        np.savez(folder / "cameras.npz", **cameras)
        np.save(folder / "body.npy", np.random.default_rng(0).normal(size=(99, 3)) * 0.2)
END"""
# Rendered scans as a user's capture: a folder of photographs, one of masks, and a calibration.
_CAPTURE = """python - <<'END'
import json, shutil
from pathlib import Path
import numpy as np
root, cameras = Path("rendered/val"), {}
names = sorted(p.name for p in (root / "img").iterdir())[:16:4]
for folder in ("photographs", "masks"):
    Path(folder).mkdir()
for name in names:
    shutil.copy(root / "img" / name / "0.jpg", f"photographs/{name}.jpg")
    shutil.copy(root / "mask" / name / "0.png", f"masks/{name}.png")
    cameras[name] = {kind + "s": np.load(root / "parm" / name / f"0_{kind}.npy").tolist()
                     for kind in ("intrinsic", "extrinsic")}
Path("cameras.json").write_text(json.dumps({"cameras": cameras}))
for instant in "12":
    shutil.copytree("photographs", f"instants/{instant}")
    shutil.copytree("masks", f"instant_masks/{instant}")
END"""
# Documents, with commands that create the files that a document requires.
BEFORE = {
    "docs/data.md": (
        f"python scripts/miniature.py data=thuman2 data.root=rendered {FEW}",
        _SCANS.format("THuman2.0_Release"),
        _PHOTOGRAPHS,
    ),
    "docs/evidence/benchmark.md": _RENDERED,
    "docs/evidence/photographs.md": _RENDERED,
    "docs/evidence/rounds.md": _RENDERED,
    "docs/extend.md": (*_RENDERED, _ABLATION),
    "docs/method.md": _RENDERED,
    "docs/performance.md": _CHECKPOINTS,
    "docs/reproduce.md": (
        _SCANS.format("THuman2.0_Release"),
        f"python scripts/miniature.py data=zju_mocap data.root=zju_mocap {FEW}",
        f"python scripts/miniature.py data=humman data.root=humman {FEW}",
        "cp humman_body_models/smpl/SMPL_NEUTRAL.pkl .",
        _SWEEP,
    ),
    "docs/photographs.md": (
        f"{_RUN} hydra.run.dir=runs/mine",
        f"python scripts/miniature.py data=thuman2 data.root=rendered {FEW} --size 112",
        _CAPTURE,
    ),
    "docs/tables.md": (_SWEEP,),
    "docs/training.md": (f"{_RUN} hydra.run.dir=runs/before", _SWEEP),
}  # fmt: skip
# Definitions for Python blocks of a document.
GIVEN = {
    "docs/rasterizer.md": """
import torch
from ghgs_lit import Cameras, Gaussians
near, one = torch.rand(50, 3) + torch.tensor([0, 0, 2]), torch.ones(50)
gaussians = Gaussians(near, torch.rand(50, 4), torch.rand(50, 3) / 9, one / 2, torch.rand(50, 3), (50,))
cameras = Cameras(torch.tensor([[[[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]]]), torch.eye(4)[None, None], 32, 32)
""",
}
# Patterns of the commands of a document that end within seconds, and of their prerequisites.
FAST = {
    "README.md": r"ghgs train --help|.*dry_run=true|.*data\.source=my_scans|"
    r"ghgs prepare .*rendered|ghgs train experiment=scans .*runs/mine|"
    r"ghgs train .*trainer=gpu|ghgs predict|#python",
    "docs/rasterizer.md": r"#python",
    "docs/tables.md": r"ghgs table",
    "docs/training.md": r".*dry_run=true",
}
