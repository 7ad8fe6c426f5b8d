"""The depth head in ``examples/stereo``, and the models that tables compare with the paper's."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from omegaconf import OmegaConf
from scipy.ndimage import map_coordinates
from torch.autograd import gradcheck

from ghgs_lit import GHGS
from ghgs_lit.config import compose, registry
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.bounds import SubjectBox
from ghgs_lit.method.stages import STAGES
from tests.helpers.models import close, load_model, predict
from tests.helpers.people import render_boxes
from tests.helpers.scenes import ellipsoid, make_batch, ring, stack
from tests.helpers.verbs import ghgs
from tests.method.heads.test_depth import make_tokens

SMALL = ["encoder.width=32", "encoder.heads=2", "encoder.vit.channels=8"]
PEERS = ["gps", "pixel"]
CELL = 4
FOLDER = Path(__file__).parents[1] / "examples" / "stereo"


@pytest.fixture(autouse=True)
def stereo(monkeypatch):
    """The plug-in."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry, "_REGISTERED", dict(registry._REGISTERED))
    monkeypatch.setenv(registry.VARIABLE, str(FOLDER / "stereo.py"))
    registry.load_plugins()
    yield sys.modules["stereo"]
    sys.modules.pop("stereo", None)


def peer(name):
    """A small model moved away from its initial state, in which depths are constant."""
    searched = f"hydra.searchpath=[file://{FOLDER / 'conf'}]"
    config = OmegaConf.masked_copy(compose("train", [searched, f"model={name}", *SMALL]), [*STAGES, "model"])
    torch.manual_seed(0)
    model = GHGS.from_config(OmegaConf.to_container(config, resolve=True)).eval()
    head = model.depth_head
    last = head.update.change[-1] if name == "gps" else head.dpt.scratch.output_conv2[-1]
    torch.nn.init.normal_(last.weight, std=0.5)
    return model


def paint_features(count, size):
    """Features of cells, a random function of the position on an ellipsoid; with cameras, whole cells and
    true depths."""
    cameras = ring(1, count, size, size)
    masks, depths = ellipsoid(cameras)
    g = torch.Generator().manual_seed(2)
    waves, phases = 25 * torch.randn(3, 32, generator=g), 6.28 * torch.rand(32, generator=g)
    maps = torch.sin(unproject_maps(depths, cameras) @ waves + phases) * masks[..., None]
    cells = size // CELL
    features = F.avg_pool2d(maps.flatten(0, 1).movedim(-1, 1), CELL)
    whole = F.avg_pool2d(masks.flatten(0, 1).float(), CELL) == 1
    mean = F.avg_pool2d(depths.flatten(0, 1), CELL)
    return F.normalize(features, dim=1).unflatten(0, (1, count)), cameras.resize(cells, cells), whole, mean


def limits(depth, whole):
    near, far = depth[whole].min() - 0.2, depth[whole].max() + 0.2
    return (bound.expand(1, len(depth), 1, 1) for bound in (near, far))


def test_correlations_are_those_of_a_literal_loop(stereo):
    """NumPy matrices and SciPy's interpolation in float64, cell by cell; each of 5 cameras has 2
    neighbours."""
    features, cameras, whole, depth = paint_features(5, 56)
    near, far = limits(depth, whole)
    cells = whole.flatten().nonzero()[::7, 0]
    found = stereo.correlations(features, cameras, cells, near, far, 9)
    k, e = cameras.intrinsics[0].double().numpy(), cameras.extrinsics[0].double().numpy()
    maps, (height, width) = features[0].double().numpy(), features.shape[-2:]
    inverse = np.linspace(1 / near[0, 0].item(), 1 / far[0, 0].item(), 9)
    for cell, row in zip(cells.tolist(), found.numpy(), strict=True):
        view, v, u = np.unravel_index(cell, (5, height, width))
        expected = []
        for z in 1 / inverse:
            at_camera = z * np.linalg.solve(k[view], [u + 0.5, v + 0.5, 1])
            point = np.linalg.solve(e[view], [*at_camera, 1])
            values = []
            for other in ((view + 1) % 5, (view - 1) % 5):
                x, y, w = k[other] @ (e[other] @ point)[:3]
                place = np.array([[y / w - 0.5], [x / w - 0.5]])
                there = [map_coordinates(m, place, order=1, mode="constant")[0] for m in maps[other]]
                values.append(maps[view, :, v, u] @ there / 32**0.5)
            expected.append(max(values))
        np.testing.assert_allclose(row, expected, atol=1e-5)


def test_upsampled_maps_are_convex_combinations(stereo):
    """With all weight on its own, a cell is repeated; with equal weights the result is the mean of 3 x 3
    cells."""
    maps = torch.rand(2, 1, 3, 5)
    weights = torch.zeros(2, 9, 16, 3, 5)
    weights[:, 4] = 1e4
    found = stereo.upsample(maps, weights.flatten(1, 2))
    assert torch.equal(found, F.interpolate(maps, scale_factor=4, mode="nearest")[:, 0])
    mean = F.avg_pool2d(F.pad(maps, (1, 1, 1, 1), mode="replicate"), 3, 1)
    found = stereo.upsample(maps, torch.zeros(2, 144, 3, 5))
    torch.testing.assert_close(found, F.interpolate(mean, scale_factor=4, mode="nearest")[:, 0])


def test_gradients_are_those_of_finite_differences(stereo):
    """Of correlations with respect to features, of an update and of upsampling with respect to all
    inputs."""
    torch.manual_seed(3)
    features, cameras, whole, depth = paint_features(2, 40)
    near, far = (bound.double() for bound in limits(depth, whole))
    cells = whole.flatten().nonzero()[::9, 0]
    features = features[:, :, :4].double().requires_grad_()
    assert gradcheck(lambda x: stereo.correlations(x, cameras, cells, near, far, 4), (features,))
    update = stereo.Update(2).double()
    torch.nn.init.normal_(update.change[-1].weight)
    levels = [torch.rand(1, 8 // 2**i, 2, 1, dtype=torch.float64, requires_grad=True) for i in range(3)]
    maps = [torch.rand(1, n, 2, 1, dtype=torch.float64, requires_grad=True) for n in (2, 2, 1)]
    assert gradcheck(lambda *x: update(x[0], x[1], list(x[3:]), x[2]), (*maps, *levels))
    weights = torch.rand(1, 144, 2, 1, dtype=torch.float64, requires_grad=True)
    assert gradcheck(stereo.upsample, (maps[2], weights))


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.parametrize(("views", "size"), [(2, (42, 70)), (3, (56, 28)), (5, (28, 42))])
def test_batch_mates_change_nothing(name, views, size):
    """Includes sides that are not multiples of a cell, and a view without a subject."""
    model, batches = peer(name), [make_batch(1, views, *size), make_batch(1, views, *size, zoom=0.6)]
    masks = batches[0].masks.clone()
    masks[:, 0] = False
    batches[0] = dataclasses.replace(batches[0], masks=masks)
    both = predict(model, stack(batches))
    assert both.depth.isfinite().all()
    assert both.depth.shape == (2, views, *size)
    assert both.gaussians.splits == tuple(int(batch.masks.sum()) for batch in batches)
    for element, batch in enumerate(batches):
        alone = predict(model, batch)
        close(both.gaussians[element], alone.gaussians)
        torch.testing.assert_close(both.depth[element], alone.depth[0])


def test_depths_lie_between_the_bounds_of_the_subject(stereo):
    """Between those of its nearest and farthest pixels; far outside, the gradient points back."""
    batch, model = make_batch(1, 3, 56, 56), peer("gps")
    bounds = SubjectBox()(batch)
    for change in (-1e4, 1e4):
        torch.nn.init.constant_(model.depth_head.update.change[-1].bias, change)
        model.zero_grad()
        depth = model.depth_head(make_tokens(batch), batch, bounds).depth
        near, far = stereo.subject_range(bounds, batch)
        assert ((depth >= near * (1 - 1e-6)) & (depth <= far * (1 + 1e-6))).all()
        (depth * change).sum().backward()
        assert (model.depth_head.update.change[-1].bias.grad * change > 0).all()


def test_a_sweep_and_its_table_compare_it_with_others(tmp_path, monkeypatch, capsys):
    """Trained, saved, loaded and evaluated from outside the package, with the same commands."""
    render_boxes(tmp_path / "rendered", tmp_path / "scans", train=1, val=1)
    monkeypatch.chdir(tmp_path)
    common = ["--config-dir", str(FOLDER / "conf"), "views=v3", "evaluation.targets=[midway]"]
    common += ["evaluation.pictures=0"]
    small = ["data=scans", "data.root=rendered", "data.size=28", "loss=depth", *SMALL]
    quick = ["trainer.max_steps=2", "logger=none", "callbacks=none", "hydra.sweep.dir=sweep"]
    assert ghgs("train", "-m", *common, *small, *quick, "model=gps,pixel") == 0
    capsys.readouterr()
    table = ["layout=table3", "reported=false", "evaluation.views=[3]", "columns=[psnr]"]
    assert ghgs("table", "runs=sweep", *table, "hydra.run.dir=table") == 0
    out = capsys.readouterr().out
    assert "After GPS-Gaussian" in out
    assert "Pixel-aligned" in out
    for path in Path("sweep").glob("*/metrics.json"):
        trained = json.loads(path.read_text())
        if trained["provenance"]["config"]["model"]["name"] == "gps":
            break
    checkpoint = path.parent / "checkpoints" / "last.ckpt"
    assert ghgs("evaluate", *common, f"checkpoint={checkpoint}", "hydra.run.dir=measured") == 0
    measured = json.loads(Path("measured/metrics.json").read_text())
    assert [row["psnr"] for row in measured["rows"]] == [row["psnr"] for row in trained["rows"]]
    del registry._REGISTERED["depth_head", "stereo"]
    monkeypatch.delenv(registry.VARIABLE)
    with pytest.raises(InputError, match=rf"depth_head\.kind: expected .*{registry.VARIABLE}"):
        load_model(checkpoint)


def test_the_number_of_depths_can_be_halved_for_each_resolution(stereo):
    with pytest.raises(InputError, match=r"consistency_depths: expected .* and a multiple of 4; found 46"):
        stereo.StereoHeadOptions(consistency_depths=46)
