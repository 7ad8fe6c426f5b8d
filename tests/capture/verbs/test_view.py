"""The viewer of predictions."""

import json
import shutil
import socket
import urllib.request

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghgs_capture.export import OutputOptions, write_prediction
from ghgs_capture.verbs.view import Viewer, read_content
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import project
from ghgs_lit.ply import write_ply
from ghgs_lit.rendering import Renderer
from tests.helpers.splats import body, camera_ring
from tests.helpers.training import photographed
from tests.helpers.verbs import ghgs

PORT = 18180  # the next free one is taken


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    """Directory of a prediction whose photographs are renderings of its Gaussians."""
    path = tmp_path_factory.mktemp("prediction")
    given = photographed(body(600, 60), camera_ring(3, 50, 60))
    write_prediction(path, *given, Renderer(), OutputOptions(("ply", "inputs")))
    return path


def test_the_hull_lies_on_the_silhouettes(directory):
    """Points of the hull project into the (dilated) mask of every view."""
    content = read_content(directory, None)
    points = torch.from_numpy(content.hull)
    assert len(points) > 100
    cameras = content.cameras
    for view in range(3):
        pixels, depth = project(points, cameras.intrinsics[view], cameras.extrinsics[view])
        assert (depth > 0).all()
        rows, columns = pixels[:, 1].long().clamp(0, 49), pixels[:, 0].long().clamp(0, 59)
        grown = torch.nn.functional.max_pool2d(content.batch.masks[0, view][None].float(), 9, 1, 4)[0] > 0
        assert grown[rows, columns].float().mean() > 0.98


def test_the_page_is_served_on_this_machine_and_its_controls_work(directory):
    content = read_content(directory, None)
    viewer = Viewer(content, port=PORT)
    try:
        assert viewer.address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(viewer.address, timeout=5) as answer:
            assert b"<html" in answer.read()
        nodes = set(viewer.server.scene._handle_from_node_name)
        assert {"/gaussians", "/hull", "/cameras/0", "/cameras/2"} <= nodes
        pose, fov = viewer._poses[1]
        extrinsics = content.cameras.extrinsics[1].numpy()
        rotation = Rotation.from_quat(pose["wxyz"], scalar_first=True).as_matrix()
        assert np.allclose(rotation.T, extrinsics[:3, :3], atol=1e-5)
        assert np.allclose(extrinsics[:3, :3] @ pose["position"] + extrinsics[:3, 3], 0, atol=1e-5)
        assert np.tan(fov / 2) * content.cameras.intrinsics[1, 1, 1] == pytest.approx(25, rel=1e-5)
        assert all(frustum.visible for frustum in viewer._frustums)
        viewer.go_to(0)
        assert [frustum.visible for frustum in viewer._frustums] == [False, True, True]
    finally:
        viewer.stop()


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_a_ply_alone_is_shown(up, tmp_path):
    """Without cameras there is no hull."""
    write_ply(body(50, 60), tmp_path / "a.ply")
    content = read_content(tmp_path / "a.ply", up)
    assert content.batch is None
    assert content.up.abs().sum() == 1
    viewer = Viewer(content, port=PORT)
    viewer.stop()


def test_what_cannot_be_shown_is_one_line(directory, tmp_path, capsys):
    with pytest.raises(InputError, match="expected a directory of ghgs predict or a PLY; found 'neither'"):
        read_content(tmp_path / "nothing", None)
    with pytest.raises(InputError, match=r"gaussians\.ply: expected a file of ghgs predict formats=\[ply\]"):
        read_content(tmp_path, None)
    assert ghgs("view", f"hydra.run.dir={tmp_path / 'r'}") == 1
    assert "ghgs view: path: expected" in capsys.readouterr().err
    (tmp_path / "b.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    with pytest.raises(InputError, match=r"b\.ply"):
        read_content(tmp_path / "b.ply", None)


def test_the_verb_opens_the_page(directory, tmp_path, capsys):
    arguments = [f"path={directory}", f"hydra.run.dir={tmp_path}", f"port={PORT}", "seconds=0.1"]
    assert ghgs("view", *arguments) == 0
    assert "viewer: http://127.0.0.1:" in capsys.readouterr().out


@pytest.mark.parametrize("host", ["192.0.2.7", "no.such.host.invalid", ".", "a" * 300])
def test_an_address_of_another_machine_is_named(directory, host):
    """viser would try a thousand of its ports, and then wait silently."""
    with pytest.raises(InputError, match="host: expected an address of this machine; found"):
        Viewer(read_content(directory, None), host, PORT)


@pytest.mark.parametrize("listens", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://{host}", 101), ("https://{host}", 101), (None, 101), ("http://evil.example", 403),
        ("http://{host}.evil.example", 403), ("http://evil.example?://{host}.", 403), ("null", 403),
        ("http://127.0.0.1:1", 403), ("http://evil.example:{port}", 403),
    ],
)  # fmt: skip
def test_pages_of_other_sites_get_no_connection(tmp_path, listens, origin, status):
    """A page that is open in the same browser must not read the photographs."""
    write_ply(body(50, 60), tmp_path / "a.ply")
    viewer = Viewer(read_content(tmp_path / "a.ply", None), listens, PORT)
    try:
        host = viewer.address.removeprefix("http://")
        lines = [
            "GET / HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13",
        ]  # fmt: skip
        name, port = host.split(":")
        lines += [f"Origin: {origin.format(host=host, port=port)}"] if origin else []
        with socket.create_connection((name, int(port)), timeout=20) as connection:
            connection.sendall("\r\n".join([*lines, "", ""]).encode())
            assert connection.recv(100).split()[1] == str(status).encode()
    finally:
        viewer.stop()


@pytest.mark.parametrize("name", ["../outside", "{tmp}/outside", "link"])
def test_the_viewer_opens_nothing_outside_its_folder(directory, tmp_path, name):
    folder = tmp_path / "prediction"
    shutil.copytree(directory, folder)
    photograph = next((folder / "inputs").glob("*.png"))
    shutil.copy(photograph, tmp_path / "outside.png")
    shutil.copy(photograph, folder / "outside.png")
    (folder / "inputs" / "link.png").symlink_to(tmp_path / "outside.png")
    cameras = json.loads((folder / "cameras.json").read_text())
    first, second, _ = cameras["cameras"]
    cameras["cameras"][name.format(tmp=tmp_path)] = cameras["cameras"].pop(first)
    if name != "link":  # names of two folders keep them
        cameras["cameras"]["other/outside"] = cameras["cameras"].pop(second)
    (folder / "cameras.json").write_text(json.dumps(cameras))
    with pytest.raises(InputError, match=r"\.png: expected the photograph of camera"):
        read_content(folder, None)
