"""Gaussians saved as PLY files."""

import dataclasses

import numpy as np
import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.ply import read_ply, write_ply
from ghgs_lit.rendering import render
from ghgs_lit.types import Gaussians
from tests.helpers.training import ring


def gaussians(n=50, seed=0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g) * 0.3,
        quaternions=torch.randn(n, 4, generator=g) * 3,
        scales=torch.rand(n, 3, generator=g) * 0.05 + 0.01,
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        colors=torch.rand(n, 3, generator=g),
        splits=(n,),
    )


def test_the_viewer_of_3d_gaussian_splatting_reads_it(tmp_path):
    """As in SIBR's ``GaussianView.cpp``: the third line contains the count, followed by records of degree
    0."""
    written = gaussians()
    write_ply(written, tmp_path / "a.ply")
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    count = int(header.split(b"\n")[2].split()[2])
    record = [("pos", "<f4", 3), ("n", "<f4", 3), ("sh", "<f4", 3), ("opacity", "<f4")]
    points = np.frombuffer(body, [*record, ("scale", "<f4", 3), ("rot", "<f4", 4)])
    assert len(points) == count == len(written)
    assert np.allclose(points["pos"], written.means)
    assert np.allclose(1 / (1 + np.exp(-points["opacity"])), written.opacities, atol=1e-5)
    assert np.allclose(np.exp(points["scale"]), written.scales, rtol=1e-5)
    assert np.allclose(0.5 + 0.28209479 * points["sh"], written.colors, atol=1e-5)
    assert np.allclose(np.linalg.norm(points["rot"], axis=1), 1, atol=1e-6)


def test_comments_that_are_not_ascii(tmp_path):
    written = gaussians()
    write_ply(written, tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    comment = "\ncomment Größe\n".encode()
    (tmp_path / "b.ply").write_bytes(content.replace(b"\n", comment, 1))
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").means, read_ply(tmp_path / "a.ply").means)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", ["-5", "1000000000000", "1" + 40 * "0"])
@pytest.mark.parametrize("rows", ["property float x", "property list int int x"])
def test_a_header_that_promises_terabytes(tmp_path, kind, count, rows):
    path = tmp_path / "a.ply"
    path.write_text(f"ply\nformat {kind} 1.0\nelement vertex {count}\n{rows}\nend_header\n1 2\n")
    with pytest.raises(InputError, match=r"a\.ply: expected a 3D Gaussian Splatting PLY; found"):
        read_ply(path)


def test_a_ply_has_the_names_and_units_of_3dgs(tmp_path):
    """Viewers of 3D Gaussian Splatting read columns by name; empty and invalid files are handled."""
    plyfile = pytest.importorskip("plyfile")
    one = Gaussians(
        torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[2.0, 0, 0, 0]]), torch.tensor([[0.1, 1.0, 0.0]]),
        torch.tensor([0.5]), torch.tensor([[0.5, 1.0, 0.0]]), (1,),
    )  # fmt: skip
    write_ply(one, tmp_path / "one.ply")
    vertex = plyfile.PlyData.read(tmp_path / "one.ply")["vertex"]
    value = {p.name: float(vertex[p.name][0]) for p in vertex.properties}
    assert np.isfinite(value.pop("scale_2"))
    expected = {"x": 1, "y": 2, "z": 3, "rot_0": 1, "rot_1": 0, "opacity": 0, "scale_0": np.log(0.1)}
    expected |= {"f_dc_0": 0, "f_dc_1": 0.5 / 0.28209479177387814}
    assert {name: value[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    nothing = one.select(slice(0, 0), (0,))
    write_ply(nothing, tmp_path / "none.ply")
    assert len(read_ply(tmp_path / "none.ply")) == 0
    with pytest.raises(InputError, match="one subject"):
        write_ply(one.select(slice(0, 1), (1, 0)), tmp_path / "two.ply")
    (tmp_path / "no.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    )
    with pytest.raises(InputError, match=r"no\.ply"):
        read_ply(tmp_path / "no.ply")


@pytest.mark.parametrize(("low_pass", "antialiased"), [(0.1, True), (0.3, False), (0.0, False)])
def test_a_ply_says_which_image_its_gaussians_were_made_for(tmp_path, low_pass, antialiased):
    """Without it, the shipped model reproduces its input views with 28 dB instead of 40 dB."""
    written = dataclasses.replace(gaussians(), low_pass=low_pass, antialiased=antialiased)
    write_ply(written, tmp_path / "a.ply")
    read = read_ply(tmp_path / "a.ply")
    assert (read.low_pass, read.antialiased) == (low_pass, antialiased)
    cameras = ring(2, 24)[None]
    a, b = (render(g, cameras, backend="reference").image for g in (written, read))
    assert a.max() > 0.2
    assert torch.allclose(a, b, atol=1e-4)


@pytest.mark.parametrize(
    ("comments", "read"),
    [
        (["ghgs_lit of another kind"], (0.3, False)),
        (["by hand", "ghgs_lit low_pass=0.1 antialiased=True"], (0.1, True)),
    ],
    ids=["another program", "ours, at the head"],
)
def test_comments_of_a_ply_that_another_program_wrote(tmp_path, comments, read):
    """Without ours, it is for the renderer of 3DGS; other programs move ours to the head, as did earlier
    versions."""
    plyfile = pytest.importorskip("plyfile")
    write_ply(dataclasses.replace(gaussians(), low_pass=0.2, antialiased=True), tmp_path / "a.ply")
    element = plyfile.PlyElement.describe(plyfile.PlyData.read(tmp_path / "a.ply")["vertex"].data, "vertex")
    plyfile.PlyData([element], comments=comments).write(tmp_path / "b.ply")
    found = read_ply(tmp_path / "b.ply")
    assert (found.low_pass, found.antialiased) == read
