"""``ghgs view``: look around in a prediction or a PLY in the browser (the extra ``viewer``).

A viser server shows the Gaussians, and the cameras with their photographs."""

import contextlib
import logging
import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_capture.calibration import calibrate
from ghgs_capture.export.subject import AXES, smooth
from ghgs_capture.formats.matrices import read_matrices
from ghgs_lit.cli.runtime import output_dir, write_config
from ghgs_lit.data.decoding import read_image
from ghgs_lit.errors import InputError, import_optional, require
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.ply import read_ply
from ghgs_lit.types import Cameras, Gaussians
from ghgs_lit.visualization.turntable import center_of, pixel_size, subject_points, up_direction

if TYPE_CHECKING:
    from ghgs_capture.verbs import View

#: Names of this machine, on which alone the page is served
_OWN_HOST = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")


@dataclass(frozen=True)
class Content:
    """Gaussians of one subject, with its cameras [V] and photographs where they are known."""

    gaussians: Gaussians
    up: Float[Tensor, "3"]
    cameras: Cameras | None = None
    photographs: dict[str, np.ndarray] | None = None  #: [h, w, 4] uint8 with alpha, by camera

    @cached_property
    def center(self) -> Float[Tensor, "3"]:
        """Centre of the subject."""
        return center_of(subject_points(self.gaussians), self.cameras)


def read_content(path: str | Path, up: str | None) -> Content:
    """Read a PLY, or a directory of ``ghgs predict`` with its formats ``ply`` and ``inputs``.

    Args:
        path: the directory or the PLY.
        up: the upward axis ``y``, ``-y`` or ``z``; None: estimated from the cameras, ``y`` for a PLY.

    Raises:
        InputError: ``path`` is neither, or a file in it is missing or wrong.
    """
    path = Path(path)
    if path.is_file():
        return Content(read_ply(path), torch.tensor(AXES[up or "y"]))
    require(path.is_dir(), f"path={path}", "a directory of ghgs predict or a PLY", "neither")
    for name, wanted in (("gaussians.ply", "ply"), ("cameras.json", "inputs")):
        if not (path / name).exists():
            raise InputError(f"{path / name}: expected a file of ghgs predict formats=[{wanted}]; found none")
    cameras, photographs = _read_inputs(path)
    direction = up_direction(cameras) if up is None else torch.tensor(AXES[up])
    return Content(read_ply(path / "gaussians.ply"), direction, cameras, photographs)


def _read_inputs(directory: Path) -> tuple[Cameras, dict[str, np.ndarray]]:
    """Read cameras and photographs of the format ``inputs``; raises InputError if one is missing or
    wrong."""
    stored = read_matrices(directory / "cameras.json")
    photographs = {}
    calibrations = []
    for name, camera in stored.cameras.items():
        file = directory / "inputs" / f"{name}.png"
        inside = file.resolve().parent == (directory / "inputs").resolve()
        require(inside, str(file), f"the photograph of camera {name} in this folder", "a file outside")
        require(file.exists(), str(file), f"the photograph of camera {name}", "none")
        photographs[name] = np.asarray(read_image(file).convert("RGBA"))
        calibrations.append(calibrate(camera, stored.convention, photographs[name].shape[:2]))
    shapes = {photograph.shape for photograph in photographs.values()}
    require(len(shapes) == 1, str(directory / "inputs"), "photographs of one size", sorted(shapes))
    intrinsics = torch.from_numpy(np.stack([camera.intrinsics for camera in calibrations])).float()
    extrinsics = torch.from_numpy(np.stack([camera.extrinsics for camera in calibrations])).float()
    return Cameras(intrinsics, extrinsics, *shapes.pop()[:2]), photographs


def _reject_other_pages(connection: Any, request: Any, response: Any) -> Any:
    """Respond with 403 to a page of another origin than this server, else None."""
    host = request.headers["Host"]
    is_own = request.headers.get("Origin") in (None, f"http://{host}", f"https://{host}")
    if response.status_code != 101 or (is_own and _OWN_HOST.fullmatch(host)):
        return None
    return connection.respond(403, "expected a page of this address\n")


@contextlib.contextmanager
def _own_pages_only() -> Iterator[None]:
    """Make servers that start in this context reject pages of other sites; viser accepts any origin."""
    from websockets.asyncio import server

    serve = server.serve
    server.serve = partial(serve, process_response=_reject_other_pages)
    try:
        yield
    finally:
        server.serve = serve


def start_server(content: Content, port: int = 8080) -> Any:
    """Start a viser server on this machine that shows one subject.

    Args:
        content: the subject.
        port: the first port to try.

    Raises:
        InputError: viser is not installed.
    """
    viser = import_optional("viser", "viewer", "ghgs view")
    logging.getLogger("websockets").setLevel(logging.WARNING)  # no line for each visitor
    with _own_pages_only():
        server = viser.ViserServer("127.0.0.1", port, label="ghgs", verbose=False)
    server.scene.set_up_direction(content.up.numpy())
    g = content.gaussians
    if content.cameras is not None:  # widened to the photographs' pixels: larger screens show no gaps
        g = smooth(g, pixel_size(content.cameras, content.center))
        _add_cameras(server, content)
    root = quaternion_to_matrix(g.quaternions) * g.scales[:, None, :]
    colors, opacities = g.colors.clamp(0, 1), g.opacities[:, None].clamp(0, 1)
    drawn = (each.numpy() for each in (g.means, root @ root.mT, colors, opacities))
    server.scene.add_gaussian_splats("/gaussians", *drawn)
    return server


def _add_cameras(server: Any, content: Content) -> None:
    """Add the cameras with their photographs, and start visitors behind the first camera and to its side,
    so that its photograph does not hide the subject."""
    from viser.transforms import SO3

    cameras = content.cameras
    target = content.center.numpy()
    centers = cameras.centers.numpy()
    size = np.linalg.norm(centers - target, axis=-1).mean()
    angles = 2 * np.arctan(cameras.height / 2 / cameras.intrinsics[:, 1, 1].numpy())
    for view, (name, photograph) in enumerate(content.photographs.items()):
        rotation = cameras.extrinsics[view, :3, :3].numpy().astype(np.float64)
        server.scene.add_camera_frustum(
            f"/cameras/{name}",
            float(angles[view]),
            cameras.width / cameras.height,
            scale=size / 12,
            thickness=size / 400,
            image=photograph,
            wxyz=SO3.from_matrix(rotation.T).wxyz,
            position=centers[view],
        )
    up = content.up.numpy().astype(np.float64)
    away = centers[0] - target
    start = server.initial_camera
    start.position = target + 1.5 * away + 0.6 * np.cross(up, away)
    start.look_at = target
    start.up = up
    start.fov = float(angles[0])


def run(verb: "View") -> None:
    """Show ``path`` until Ctrl-C.

    Raises:
        InputError: there is nothing to show, or a file is wrong.
    """
    require(verb.path is not None, "path", "a directory of ghgs predict or a PLY", None)
    write_config(verb, output_dir())
    server = start_server(read_content(verb.path, verb.up), verb.port)
    print(f"viewer: http://{server.get_host()}:{server.get_port()}; Ctrl-C ends it", flush=True)
    end = time.monotonic() + (verb.seconds or math.inf)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
    finally:
        server.stop()
