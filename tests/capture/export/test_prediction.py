"""Files of a prediction, read by other programs' readers."""

import dataclasses
import json
import re
import sys

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from gaussforge import GaussForge
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from ghgs_capture.calibration import calibrate
from ghgs_capture.export import OutputOptions, output_options, write_prediction
from ghgs_capture.export.subject import (
    AXES,
    export_subject,
    file_names,
    for_other_renderers,
    rotate_world,
    turn,
)
from ghgs_capture.formats.matrices import read_matrices
from ghgs_capture.verbs import Predict
from ghgs_lit.errors import InputError
from ghgs_lit.metrics import psnr
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.ply import read_ply
from ghgs_lit.rendering import Renderer, render
from ghgs_lit.types import Cameras
from ghgs_lit.visualization.turntable import up_direction
from tests.helpers.splats import body, camera_ring, cloud
from tests.helpers.training import Standin, example_batch, photographed

CONFIG = {"formats": ["ply"], "up": None, "smooth": False, "turntable": {"frames": 2, "fps": 12}}


def test_every_photograph_gets_a_file():
    """Names that differ only in special characters, or in case, which some file systems ignore."""
    views = ["left 1", "left_1", "left/1", "Left_1", "left_1_2", "b"]
    names = file_names(views)
    assert len({name.casefold() for name in names}) == len(views)
    assert (names[0], names[5]) == ("left_1", "b")


@pytest.fixture
def subject():
    """A batch of one subject, with a prediction of it."""
    batch = example_batch(subjects=1)
    return batch, Standin()(dataclasses.replace(batch, targets=None))


def test_everything_is_written_and_reported(subject, tmp_path):
    """The report lists each file with its size; other programs read photographs."""
    batch, prediction = subject
    options = OutputOptions(("ply", "turntable", "inputs"), frames=2)
    paths = write_prediction(tmp_path, batch, prediction, Renderer(), options, {"seconds": {"predict": 1}})
    report = json.loads((tmp_path / "report.json").read_text())
    written = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert {str(p.relative_to(tmp_path)) for p in paths} == written == {*report["files"], "report.json"}
    assert report["gaussians"] == len(prediction.gaussians)
    assert report["seconds"] == {"predict": 1}
    valid = batch.masks[0].numpy()
    photograph = iio.imread(tmp_path / "inputs" / "000_0.png")
    assert np.array_equal(photograph[..., 3] > 0, valid[0])
    stored = read_matrices(tmp_path / "cameras.json")
    read = calibrate(stored.cameras["001_0"], stored.convention, (16, 16))
    assert np.allclose(read.intrinsics, batch.cameras.intrinsics[0, 1], atol=1e-6)
    assert np.allclose(read.extrinsics, batch.cameras.extrinsics[0, 1], atol=1e-7)


def test_mattes_are_the_alpha_of_the_photographs(subject, tmp_path):
    """Colours in a PNG are not premultiplied; on black they yield the model's input."""
    batch, prediction = subject
    share = torch.rand(batch.masks.shape, generator=torch.Generator().manual_seed(1)) * batch.masks
    batch = dataclasses.replace(batch, images=batch.images * share[:, :, None], alpha=share)
    write_prediction(tmp_path, batch, prediction, Renderer(), OutputOptions(("inputs",)))
    picture = iio.imread(tmp_path / "inputs" / "000_0.png") / 255
    assert np.abs(picture[..., 3] - share[0, 0].numpy()).max() <= 0.5 / 255 * 1.001
    seen = batch.images[0, 0].movedim(0, -1).numpy()
    assert np.abs(picture[..., :3] * picture[..., 3:] - seen).max() <= 1 / 255 * 1.001


def test_up_turns_everything_and_changes_no_picture(subject, tmp_path):
    """With up=z the cameras' up is +z; Gaussians and cameras remain consistent."""
    batch, prediction = subject
    write_prediction(tmp_path, batch, prediction, Renderer(), OutputOptions(("ply", "inputs"), up="z"))
    gaussians, own = read_ply(tmp_path / "gaussians.ply"), batch.cameras[0]
    written = json.loads((tmp_path / "cameras.json").read_text())["cameras"].values()
    extrinsics = torch.tensor([camera["extrinsics"] for camera in written])
    cameras = Cameras(own.intrinsics, extrinsics, own.height, own.width)
    assert torch.allclose(up_direction(cameras), torch.tensor([0, 0, 1.0]).double(), atol=1e-5)
    assert -extrinsics[:, 1, 2].mean() > 0.9  # image rows point downwards
    before = render(prediction.gaussians, batch.cameras, backend="reference").image
    after = render(gaussians, cameras[None], backend="reference").image
    assert torch.allclose(before, after, atol=1e-4)


UPS = [(0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, -1), (1, 0, 0), (0.6, -0.64, 0.48), (0, -1, 1e-9)]


@pytest.mark.parametrize("end", AXES)
def test_a_world_is_turned_as_scipy_turns_it(end):
    """Also for opposite directions; renderings do not change."""
    for up in UPS:
        up = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
        axis = torch.tensor(AXES[end], dtype=torch.float64)
        quaternion = turn(up, axis)
        rotation = Rotation.from_quat(quaternion.numpy(), scalar_first=True)
        assert np.allclose(rotation.apply(up.numpy()), axis.numpy(), atol=1e-7)
        gaussians, cameras = cloud(20), camera_ring(2, 16, 20)
        turned, moved = rotate_world(quaternion, gaussians, cameras)
        assert np.allclose(turned.means, rotation.apply(gaussians.means.numpy()), atol=1e-6)
        images = [
            render(*pair, backend="reference").image for pair in ((gaussians, cameras), (turned, moved))
        ]
        assert torch.allclose(*images, atol=1e-4)


def test_gaussians_that_are_not_finite_are_counted_and_left_out(subject, tmp_path):
    """Viewers fail on files with NaN; our renderer skips such Gaussians."""
    batch, prediction = subject
    prediction.gaussians.means.data[3, 1] = torch.nan
    write_prediction(tmp_path, batch, prediction, Renderer(), OutputOptions())
    assert json.loads((tmp_path / "report.json").read_text())["gaussians_not_finite"] == 1
    vertices = PlyData.read(tmp_path / "gaussians.ply")["vertex"]
    assert len(vertices) == len(prediction.gaussians) - 1
    assert np.isfinite(vertices["y"]).all()


def test_a_subject_without_gaussians_is_written(subject, tmp_path):
    """Empty masks yield empty files and a report without numbers."""
    batch, _ = subject
    batch = dataclasses.replace(batch, masks=torch.zeros_like(batch.masks), targets=None)
    options = OutputOptions(("ply", "html", "turntable", "inputs"), frames=1)
    write_prediction(tmp_path, batch, Standin()(batch), Renderer(), options)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["gaussians"] == 0
    assert set(report["psnr_box_of_inputs"].values()) == {None}
    with pytest.raises(
        InputError, match="formats: expected Gaussians that gaussforge converts to spz; found 0: "
    ):
        write_prediction(tmp_path, batch, Standin()(batch), Renderer(), OutputOptions(("spz",)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"formats": ["obj"]}, "formats: expected one of all, ply, .*; found 'obj'"),
        ({"up": "x"}, "up: expected one of y, -y, z or null; found 'x'"),
        (
            {"formats": "all", "turntable": {"frames": 0, "fps": 1}},
            r"turntable\.frames: expected at least 1 for formats=mp4; found 0",
        ),
        ({"turntable": {"frames": -1, "fps": 1}}, r"turntable\.frames: expected .*; found -1"),
    ],
)
def test_wrong_options_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        output_options(Predict(**(CONFIG | changes)))


def test_options_are_read():
    """One name, a list with duplicates, and ``all``."""
    assert output_options(Predict(formats="ply")).formats == ("ply",)
    assert output_options(Predict(formats=["ply", "html", "ply"])).formats == ("ply", "html")
    assert "inputs" in output_options(Predict(formats=["all"])).formats
    batch = example_batch()
    with pytest.raises(InputError, match="a batch of one subject; found 2"):
        write_prediction(None, batch, Standin()(batch), Renderer(), OutputOptions())


def test_a_missing_package_is_named_before_any_work(monkeypatch):
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    line = r"formats=spz: expected the package gaussforge \(pip install 'ghgs-lit\[formats\]'\); found none"
    with pytest.raises(InputError, match=line):
        output_options(Predict(formats=["ply", "spz"]))


@pytest.mark.parametrize(("antialiased", "size"), [(False, 0.3), (True, 1.0)])
def test_smooth_files_have_no_gaps_on_larger_screens(tmp_path, antialiased, size):
    """At four times the resolution, a smooth file renders as the enlarged image; another renders as dots."""
    gaussians, cameras = body(1500, 60), camera_ring(2, 60, 60)
    gaussians = dataclasses.replace(gaussians, scales=gaussians.scales * size, antialiased=antialiased)
    batch, prediction = photographed(gaussians, cameras)
    alphas = {}
    for smooth in (False, True):
        write_prediction(tmp_path, batch, prediction, Renderer(), OutputOptions(smooth=smooth))
        large = render(read_ply(tmp_path / "gaussians.ply"), cameras.resize(240, 240)).alpha[0, :, 0]
        alphas[smooth] = torch.nn.functional.avg_pool2d(large, 4)
    wanted = render(gaussians, cameras).alpha[0, :, 0]
    errors = {smooth: float((alpha - wanted).abs()[wanted > 0.5].mean()) for smooth, alpha in alphas.items()}
    assert errors[True] < 0.1
    assert antialiased or errors[False] > 3 * errors[True]


def made_for_thin_pixels(size: int = 60):
    """Discs of about a pixel for a low-pass of 0.1 px^2 with antialiasing, and their renderings."""
    gaussians, cameras = body(1500, size), camera_ring(2, size, size)
    gaussians = dataclasses.replace(gaussians, low_pass=0.1, antialiased=True)
    return photographed(gaussians, cameras)


def test_other_viewers_draw_what_ours_draws(tmp_path):
    """Other viewers add 0.3 px^2 and do not antialias: their files compensate for it, the PLY states it."""
    batch, prediction = made_for_thin_pixels()
    wanted, boxes = batch.images[0], box_of(batch.masks[0])
    write_prediction(tmp_path, batch, prediction, Renderer(), OutputOptions(("ply", "sog"), frames=0))
    exact = render(read_ply(tmp_path / "gaussians.ply"), batch.cameras).image[0]
    assert psnr(exact, wanted, boxes).min() > 60
    data = GaussForge().convert((tmp_path / "gaussians.sog").read_bytes(), "sog", "ply")["data"]
    (tmp_path / "viewer.ply").write_bytes(data)
    adapted = render(read_ply(tmp_path / "viewer.ply"), batch.cameras).image[0]
    as_is = dataclasses.replace(prediction.gaussians, low_pass=0.3, antialiased=False)
    blurred = render(as_is, batch.cameras).image[0]
    gain = psnr(adapted.clamp(0, 1), wanted, boxes) - psnr(blurred.clamp(0, 1), wanted, boxes)
    assert gain.min() > 4


def test_other_viewers_see_the_inputs_as_ours_does():
    """The fit is better than with scales and opacities only; between the inputs, discs with random colours
    lose less than 1 dB; positions and rotations do not change."""
    batch, prediction = made_for_thin_pixels()
    ours = prediction.gaussians
    subject = export_subject(batch, prediction, Renderer(), OutputOptions())
    found, converted = subject.for_other_renderers, for_other_renderers(ours, subject.pixel)
    between = camera_ring(5, 60, 60)[:, 1:]
    for cameras, gain in ((batch.cameras, 2.0), (between, -1.0)):
        wanted, nearer, before = (render(g, cameras).image[0] for g in (ours, found, converted))
        boxes = box_of(render(ours, cameras).alpha[0, :, 0] > 0.5)
        assert (psnr(nearer, wanted, boxes) > psnr(before, wanted, boxes) + gain).all()
    assert torch.equal(found.means, ours.means)
    assert torch.equal(found.quaternions, ours.quaternions)


def test_gaussians_for_other_viewers_stay_as_they_are():
    gaussians = body(50, 60)
    assert for_other_renderers(gaussians, 0.01) is gaussians


def test_no_picture_of_a_turntable_cuts_the_subject(tmp_path):
    """Also if optical axes meet elsewhere, since the principal point of crops may be anywhere."""
    gaussians, cameras = body(1500, 60), camera_ring(3, 60, 60)
    # the subject is above the point that all cameras look at
    shift = torch.tensor([0.0, 0.7, 0.0])
    gaussians = dataclasses.replace(gaussians, means=gaussians.means + shift)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 1, 2] -= 0.7 / 3.0 * intrinsics[..., 1, 1]
    cameras = dataclasses.replace(cameras, intrinsics=intrinsics)
    batch, prediction = photographed(gaussians, cameras)
    assert batch.masks.any()
    options = OutputOptions(("turntable", "html"), frames=5)
    write_prediction(tmp_path, batch, prediction, Renderer(), options)
    for frame in range(5):
        picture = iio.imread(tmp_path / "turntable" / f"{frame:03d}.png").max(-1)
        assert picture.max() > 100
        assert max(border.max() for border in (picture[0], picture[-1], picture[:, 0], picture[:, -1])) == 0
    target = re.search(r'"target": \[([^]]*)\]', (tmp_path / "viewer.html").read_text())[1]
    assert np.allclose([float(value) for value in target.split(",")], shift, atol=0.05)


def test_only_files_of_earlier_predictions_are_replaced(subject, tmp_path):
    """Files of an earlier prediction remain listed after runs that write others, unless they are deleted."""
    batch, prediction = subject

    def write(*formats):
        return write_prediction(tmp_path, batch, prediction, Renderer(), OutputOptions(formats, frames=0))

    write("html", "inputs")
    write("ply")
    write("html", "inputs")
    (tmp_path / "gaussians.spz").write_text("somebody's")
    with pytest.raises(InputError, match=r"gaussians\.spz: expected no file, or one that an earlier"):
        write("ply", "spz")
    assert (tmp_path / "gaussians.spz").read_text() == "somebody's"
    (tmp_path / "gaussians.ply").unlink()
    write("html")
    (tmp_path / "gaussians.ply").write_text("somebody's, where ours was")
    with pytest.raises(InputError, match=r"gaussians\.ply: expected no file, or one that an earlier"):
        write("ply")
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(InputError, match=r"found 'another file'"):
        write("ply")
