"""The viewer of predictions."""

import json
import shutil
import socket
import urllib.request

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ghgs_capture.export import OutputOptions, write_prediction
from ghgs_capture.verbs.view import read_content, start_server
from ghgs_lit.errors import InputError
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


@pytest.fixture
def serve():
    """Function that starts the server for some content; stopped at the end."""
    servers = []

    def start(content):
        servers.append(start_server(content, PORT))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()


def address_of(server):
    return f"{server.get_host()}:{server.get_port()}"


def test_the_page_is_served_on_this_machine(directory, serve):
    content = read_content(directory, None)
    server = serve(content)
    assert server.get_host() == "127.0.0.1"
    with urllib.request.urlopen(f"http://{address_of(server)}", timeout=5) as answer:
        assert b"<html" in answer.read()
    nodes = server.scene._handle_from_node_name
    assert {"/gaussians", "/cameras/0", "/cameras/2"} <= set(nodes)
    frustum = nodes["/cameras/1"]
    extrinsics = content.cameras.extrinsics[1].numpy()
    rotation = Rotation.from_quat(frustum.wxyz, scalar_first=True).as_matrix()
    assert np.allclose(rotation.T, extrinsics[:3, :3], atol=1e-5)
    assert np.allclose(extrinsics[:3, :3] @ frustum.position + extrinsics[:3, 3], 0, atol=1e-5)
    assert np.tan(frustum.fov / 2) * content.cameras.intrinsics[1, 1, 1] == pytest.approx(25, rel=1e-5)


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_a_ply_alone_is_shown(up, tmp_path, serve):
    write_ply(body(50, 60), tmp_path / "a.ply")
    content = read_content(tmp_path / "a.ply", up)
    assert content.cameras is None
    assert content.up.abs().sum() == 1
    serve(content)


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


@pytest.mark.parametrize(
    ("origin", "status", "host"),
    [
        ("http://{host}", 101, "{host}"), ("https://{host}", 101, "{host}"), (None, 101, "{host}"),
        ("http://localhost:9000", 101, "localhost:9000"), ("http://evil.example", 403, "{host}"),
        ("http://{host}.evil.example", 403, "{host}"), ("http://evil.example?://{host}.", 403, "{host}"),
        ("null", 403, "{host}"), ("http://127.0.0.1:1", 403, "{host}"),
        ("http://evil.example:{port}", 403, "{host}"), ("http://evil.example:80", 403, "evil.example:80"),
    ],
)  # fmt: skip
def test_pages_of_other_sites_get_no_connection(tmp_path, serve, origin, status, host):
    """A page that is open in the same browser must not read the photographs."""
    write_ply(body(50, 60), tmp_path / "a.ply")
    server = serve(read_content(tmp_path / "a.ply", None))
    place = server.get_host(), server.get_port()
    host = host.format(host=address_of(server))
    lines = [
        "GET / HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13",
    ]  # fmt: skip
    lines += [f"Origin: {origin.format(host=host, port=place[1])}"] if origin else []
    with socket.create_connection(place, timeout=20) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        assert connection.recv(100).split()[1] == str(status).encode()


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
