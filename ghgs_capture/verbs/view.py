"""``ghgs view``: look around in a prediction or a PLY in the browser (the extra ``viewer``).

A viser server shows the Gaussians, cameras and visual hull, each with a checkbox."""

import contextlib
import logging
import math
import re
import socket
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
from ghgs_capture.export.subject import AXES, smoothed
from ghgs_capture.formats.matrices import read_matrices
from ghgs_capture.verbs import predict
from ghgs_lit.cli.runtime import output_dir, write_config
from ghgs_lit.data.images import read_image
from ghgs_lit.errors import InputError, import_optional, require, require_choice
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.ply import read_ply
from ghgs_lit.types import Batch, Cameras, Gaussians
from ghgs_lit.visualization.pictures import to_uint8
from ghgs_lit.visualization.turntable import center_of, pixel_size, subject_points, up_direction
from ghgs_lit.weights.reading import SHIPPED

if TYPE_CHECKING:
    from ghgs_capture.verbs import View

_HULL_POINTS = 50_000


@dataclass(frozen=True)
class Content:
    """Gaussians of one subject, with its photographs, masks and cameras where they are known."""

    gaussians: Gaussians
    up: Float[Tensor, "3"]
    batch: Batch | None = None

    @property
    def cameras(self) -> Cameras:
        """Cameras [V] of the photographs."""
        return self.batch.cameras[0]

    @cached_property
    def center(self) -> Float[Tensor, "3"]:
        """Centre of the subject."""
        return center_of(subject_points(self.gaussians), self.cameras)

    @cached_property
    def hull(self) -> np.ndarray:
        """Points [n, 3] where the rays of the subject's pixels enter the visual hull, at most
        ``_HULL_POINTS``."""
        near = VisualHull(dilation=0.0)(self.batch).near
        points = unproject_maps(near, self.batch.cameras)[self.batch.masks]
        return points[:: -(-max(len(points), 1) // _HULL_POINTS)].numpy()


def read_content(path: str | Path, up: str | None) -> Content:
    """Read a PLY, or a directory of ``ghgs predict`` with its formats ``ply`` and ``inputs``.

    Args:
        path: the directory or the PLY.
        up: the upward axis ``y``, ``-y`` or ``z``; None: estimated from the cameras, ``y`` for a PLY.

    Raises:
        InputError: ``path`` is neither, or a file in it is missing or wrong.
    """
    path = Path(path)
    require_choice("up", up, (None, *AXES))
    if path.is_file():
        return Content(read_ply(path), torch.tensor(AXES[up or "y"]))
    require(path.is_dir(), f"path={path}", "a directory of ghgs predict or a PLY", "neither")
    for name, wanted in (("gaussians.ply", "ply"), ("cameras.json", "inputs")):
        if not (path / name).exists():
            raise InputError(f"{path / name}: expected a file of ghgs predict formats=[{wanted}]; found none")
    batch = _read_inputs(path)
    direction = up_direction(batch.cameras[0]) if up is None else torch.tensor(AXES[up])
    return Content(read_ply(path / "gaussians.ply"), direction, batch)


def _read_inputs(directory: Path) -> Batch:
    """Read photographs, masks and cameras of the format ``inputs``; raises InputError if one is missing or
    wrong."""
    stored = read_matrices(directory / "cameras.json")
    pictures = []
    cameras = []
    for name, camera in stored.cameras.items():
        file = directory / "inputs" / f"{name}.png"
        inside = file.resolve().parent == (directory / "inputs").resolve()
        require(inside, str(file), f"the photograph of camera {name} in this folder", "a file outside")
        require(file.exists(), str(file), f"the photograph of camera {name}", "none")
        pictures.append(np.asarray(read_image(file).convert("RGBA")))
        cameras.append(calibrate(camera, stored.convention, pictures[-1].shape[:2]))
    shapes = {picture.shape for picture in pictures}
    require(len(shapes) == 1, str(directory / "inputs"), "photographs of one size", sorted(shapes))
    values = torch.from_numpy(np.stack(pictures)).movedim(-1, 1).float()[None] / 255
    intrinsics = torch.from_numpy(np.stack([camera.intrinsics for camera in cameras])).float()[None]
    extrinsics = torch.from_numpy(np.stack([camera.extrinsics for camera in cameras])).float()[None]
    colors = values[:, :, :3]
    alpha = values[:, :, 3:]
    return Batch(
        images=torch.where(alpha > 0, colors * alpha, colors),
        masks=alpha[:, :, 0] > 0.5,
        alpha=alpha[:, :, 0],
        cameras=Cameras(intrinsics, extrinsics, *pictures[0].shape[:2]),
        views=(tuple(stored.cameras),),
    )


def _require_address(host: str) -> None:
    """Reject an address that is not this machine's: viser would wait for it silently."""
    try:
        family, *_ = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
        socket.create_server((host, 0), family=family).close()
    except (OSError, UnicodeError) as error:
        raise InputError(f"host: expected an address of this machine; found {host!r} ({error})") from error


def _refuse_other_addresses(connection: Any, request: Any, response: Any) -> Any:
    """Respond with 403 to a page whose origin is not the address that it connects to, else None."""
    origin = request.headers.get("Origin")
    if response.status_code != 101 or origin is None or origin.split("://")[-1] == request.headers["Host"]:
        return None
    return connection.respond(403, "expected a page of this address\n")


@contextlib.contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """Make servers that start in this context reject pages of other sites; viser accepts any origin."""
    from websockets.asyncio import server

    serve = server.serve
    names = "|".join(map(re.escape, (host, "localhost", "127.0.0.1", "[::1]")))
    # A server open to the network has many names; the Host header contains the one in use.
    names = ".+" if host in ("0.0.0.0", "::") else names
    origins = [None, re.compile(rf"https?://({names})(:\d+)?")]
    server.serve = partial(serve, origins=origins, process_response=_refuse_other_addresses)
    try:
        yield
    finally:
        server.serve = serve


class Viewer:
    """A viser server that shows one subject.

    Args:
        content: the subject.
        host: address to listen on; ``127.0.0.1`` is reachable from this machine only.
        port: the first port to try.

    Raises:
        InputError: viser is not installed, or this machine has no such address.
    """

    def __init__(self, content: Content, host: str = "127.0.0.1", port: int = 8080):
        viser = import_optional("viser", "viewer", "ghgs view")
        _require_address(host)
        self.content = content
        logging.getLogger("websockets").setLevel(logging.WARNING)  # no line for each visitor
        with _own_pages_only(host):
            self.server = viser.ViserServer(host, port, label="ghgs", verbose=False)
        self.server.scene.set_up_direction(content.up.numpy())
        self._add_splats()
        if content.batch is not None:
            self._add_hull()
            self._place_visitors()
            self._add_cameras()

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def stop(self) -> None:
        """Stop the server."""
        self.server.stop()

    def _add_splats(self) -> None:
        """Add the Gaussians, those of a prediction widened to the photographs' pixels so that larger
        screens show no gaps."""
        g = self.content.gaussians
        if self.content.batch is not None:
            g = smoothed(g, pixel_size(self.content.cameras, self.content.center))
        root = quaternion_to_matrix(g.quaternions) * g.scales[:, None, :]
        colors, opacities = g.colors.clamp(0, 1), g.opacities[:, None].clamp(0, 1)
        drawn = (each.numpy() for each in (g.means, root @ root.mT, colors, opacities))
        self._switch("Gaussians", self.server.scene.add_gaussian_splats("/gaussians", *drawn))

    def _add_hull(self) -> None:
        """Add the points of the visual hull, initially hidden."""
        points = self.content.hull
        size = float(np.ptp(points, axis=0).max(initial=0.0)) / 400
        blue = np.array([90, 160, 255], np.uint8)
        node = self.server.scene.add_point_cloud(
            "/hull", points, blue, point_size=size, precision="float32", visible=False
        )
        self._switch("hull", node)

    def _switch(self, name: str, node: Any) -> None:
        box = self.server.gui.add_checkbox(name, node.visible)

        @box.on_update
        def _(_) -> None:
            node.visible = box.value

    def _show_frustums(self) -> None:
        """Show all cameras except the visitors', whose photograph would hide the subject."""
        for view, frustum in enumerate(self._frustums):
            frustum.visible = self.cameras.value and view != self._at

    def _add_cameras(self) -> None:
        """Add the cameras with their photographs; a click on one moves the visitors there."""
        from viser.transforms import SO3

        cameras = self.content.cameras
        batch = self.content.batch
        self._poses = []
        self._frustums = []
        target = self.content.center.numpy()
        size = np.linalg.norm(cameras.centers.numpy() - target, axis=-1).mean()
        for view, name in enumerate(batch.views[0]):
            k = cameras.intrinsics[view].numpy()
            e = cameras.extrinsics[view].numpy().astype(np.float64)
            pose = {"wxyz": SO3.from_matrix(e[:3, :3].T).wxyz, "position": -e[:3, :3].T @ e[:3, 3]}
            fov = 2 * math.atan(cameras.height / 2 / k[1, 1])
            alpha = batch.masks[0, view].numpy() * np.uint8(255)
            node = self.server.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov,
                cameras.width / cameras.height,
                scale=size / 12,
                thickness=size / 400,
                image=np.dstack([to_uint8(batch.images[0, view]), alpha]),
                **pose,
            )
            node.on_click(lambda _, view=view: self.go_to(view))
            self._frustums.append(node)
            self._poses.append((pose, fov))
        self.cameras = self.server.gui.add_checkbox("cameras", True)
        self.cameras.on_update(lambda _: self._show_frustums())
        self._at: int | None = None  # index of the camera that visitors were moved to

    def _place_visitors(self) -> None:
        """Start visitors behind the first camera and to its side, so that its photograph does not hide the
        subject."""
        cameras = self.content.cameras
        target = self.content.center.numpy()
        up = self.content.up.numpy().astype(np.float64)
        away = cameras.centers[0].numpy() - target
        start = self.server.initial_camera
        start.position = target + 1.5 * away + 0.6 * np.cross(up, away)
        start.look_at = target
        start.up = up
        start.fov = 2 * math.atan(cameras.height / 2 / float(cameras.intrinsics[0, 1, 1]))

    def go_to(self, view: int) -> None:
        """Move all visitors to the camera of a photograph.

        Args:
            view: index of the photograph.
        """
        pose, fov = self._poses[view]
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.wxyz = pose["wxyz"]
                client.camera.position = pose["position"]
                client.camera.fov = fov
        self._at = view
        self._show_frustums()


def run(verb: "View") -> None:
    """Show ``path``, or predict first without it, until Ctrl-C.

    Raises:
        InputError: there is nothing to show, or a file or option is wrong.
    """
    sources = (verb.path, verb.checkpoint, verb.images)
    has_source = any(source is not None for source in sources)
    require(has_source, "path", "a directory of ghgs predict or a PLY, or checkpoint=<file>", None)
    if verb.path is None and verb.checkpoint is None:
        verb = verb.replace(checkpoint=SHIPPED)
    if verb.path is None:
        predict.run(verb)
    else:
        write_config(verb, output_dir())
    # A new prediction is already in the frame of ``up``, and its cameras define the axis.
    content = read_content(verb.path or output_dir(), verb.up if verb.path else None)
    viewer = Viewer(content, verb.host, verb.port)
    print(f"viewer: {viewer.address}; Ctrl-C ends it", flush=True)
    end = time.monotonic() + (verb.seconds or math.inf)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
    finally:
        viewer.stop()
