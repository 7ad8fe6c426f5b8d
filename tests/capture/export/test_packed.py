"""Packed Gaussians, unpacked in Python and by the page."""

import dataclasses
import json
import math
import re
import shutil
import subprocess
import zlib
from importlib.resources import files

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from ghgs_capture.export.page import COARSE, FINE, pack
from ghgs_lit.types import Gaussians
from tests.helpers.splats import body, unpack

PIXEL, CENTER = 0.01, torch.tensor([0.1, -0.2, 30.0])


@pytest.fixture
def gaussians() -> Gaussians:
    """Gaussians of varied shapes, colours and directions, including the values 0 and 1."""
    found = body(3000, 120)
    found.colors[:100], found.colors[100:200], found.opacities[50:150] = 0.0, 1.0, 1.0
    return dataclasses.replace(found, means=found.means + CENTER, low_pass=0.1, antialiased=True)


def packed_and_back(gaussians: Gaussians, steps=COARSE) -> Gaussians:
    return unpack(pack(gaussians, PIXEL, CENTER, steps), PIXEL, CENTER, steps, gaussians)


@pytest.mark.parametrize(("steps", "degrees"), [(FINE, 1.6), (COARSE, 6.5)])
def test_gaussians_come_back_within_half_a_step_in_their_order(gaussians, steps, degrees):
    found = packed_and_back(gaussians, steps)
    assert (found.splits, found.low_pass, found.antialiased) == ((3000,), 0.1, True)
    far = 2e-6  # what float32 rounds at 30 m
    assert (found.means - gaussians.means).abs().max() <= 0.5 * PIXEL / steps["center"] + far
    assert (found.scales / gaussians.scales).log().abs().max() <= 0.501 / steps["scale"]
    assert (found.opacities - gaussians.opacities).abs().max() <= 0.501 / steps["opacity"]
    assert (found.colors - gaussians.colors).abs().max() <= 0.501 / 255
    cosines = (normalize(found.quaternions) * normalize(gaussians.quaternions)).sum(-1).abs()
    # half a step of all three numbers, four times
    assert cosines.min() > math.cos(math.radians(degrees) / 2)


def test_floaters_and_scales_of_nothing_stay_finite(gaussians):
    """Extreme values are clamped to the nearest ones and do not affect the precision of others."""
    changed = dataclasses.replace(gaussians, means=gaussians.means.clone(), scales=gaussians.scales.clone())
    changed.means[0], changed.scales[1], changed.scales[2] = 1e9, 0.0, 1e9
    found, before = packed_and_back(changed), packed_and_back(gaussians)
    assert all(getattr(found, name).isfinite().all() for name in ("means", "scales", "quaternions"))
    assert (found.means[0] > 1e5).all()
    assert (found.scales[1] < PIXEL / 1000).all()
    assert (found.scales[2] > 1000 * PIXEL).all()
    assert torch.equal(found.means[1:], before.means[1:])
    assert torch.equal(found.scales[3:], before.scales[3:])
    assert len(packed_and_back(gaussians.select(slice(0, 0), (0,)))) == 0


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_page_unpacks_the_same(gaussians, tmp_path):
    """The page's own functions, run outside of a browser: the shader's table equals our reader's values."""
    text = files("ghgs_capture.export").joinpath("page.html").read_text()
    function = re.search(r"function table\(.*?\n}\n", text, re.S)[0]
    packed = pack(gaussians, PIXEL, CENTER, FINE)
    scene = {"steps": FINE, "pixel": PIXEL, "target": CENTER.tolist()}
    planes = list(zlib.decompress(packed))
    script = f"const scene = {json.dumps(scene)}; {function}\nconst found = table(new Uint8Array({planes}));"
    (tmp_path / "a.js").write_text(script + "process.stdout.write(new Uint8Array(found.buffer));")
    done = subprocess.run(["node", tmp_path / "a.js"], capture_output=True, check=True)
    values = np.frombuffer(done.stdout, "<f4").reshape(-1, 12)
    assert len(values) == 3 * 1024
    assert not values[3000:].any()
    values, wanted = values[:3000], unpack(packed, PIXEL, CENTER, FINE, gaussians)
    assert np.allclose(values[:, :3], wanted.means, atol=1e-6)
    assert np.allclose(values[:, 4:7], wanted.scales)
    assert np.allclose(values[:, 7], wanted.opacities)
    assert np.allclose(values[:, 8:], wanted.quaternions, atol=1e-6)
    colors = np.ascontiguousarray(values[:, 3]).view(np.uint8).reshape(-1, 4)[:, :3]
    assert np.array_equal(colors, (wanted.colors * 255).round())
