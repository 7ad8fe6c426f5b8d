"""Files that cover several instants: a page that plays them, numbered PLYs and a video."""

import math
import os
import shutil
from collections.abc import Iterable
from functools import partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from ghgs_capture.export.page import COARSE, pack, page, unpack
from ghgs_capture.export.reports import begin_files, end_files, write_file
from ghgs_capture.export.subject import ExportedSubject, OutputOptions, exported_subject, smooth
from ghgs_lit.files import write_atomically
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.visualization.pictures import to_uint8
from ghgs_lit.visualization.turntable import orbit

#: Largest angle, in radians, by which the video's camera swings to each side of the first photograph
_SWING = math.radians(20)
_VIDEO_SIDE = 720  #: Least length of the longer side of its frames, in pixels


class Instants:
    """Files that cover all instants, next to the folders of the instants.

    For ``html`` ``viewer.html``; for ``ply`` ``sequence/0000.ply`` and so on, which other programs
    import as a sequence; for ``mp4`` ``instants.mp4``. The cameras of page and video follow the
    subject's mean, smoothed over a second.

    Args:
        count: largest number of instants.
        options: formats, upward axis and frames per second.
        others: names of further files, whose contents must be set in the attribute ``others`` before
            :meth:`write`.
    """

    def __init__(self, count: int, options: OutputOptions, others: Iterable[str] = ()):
        self.count = count
        self.options = options
        self.others: dict[str, bytes] = dict.fromkeys(others, b"")
        self.folders: list[Path] = []
        self._first: ExportedSubject | None = None
        self._packed: list[bytes] = []
        self._means: list[np.ndarray] = []
        self._boxes: list[np.ndarray] = []

    @property
    def files(self) -> list[str]:
        """Names of the files that may be written, relative to the directory of all instants."""
        numbered = [f"sequence/{number:04d}.ply" for number in range(self.count)]
        names = {"html": ["viewer.html"], "ply": numbered, "mp4": ["instants.mp4"]}
        made = []
        for format, files in names.items():
            if format in self.options.formats:
                made += files
        return [*made, *self.others]

    def add(self, folder: Path, batch: Batch, prediction: Prediction, renderer: Renderer) -> None:
        """Add the next instant.

        Args:
            folder: the folder of this instant's own files.
            batch: photographs, masks and cameras of one subject.
            prediction: the prediction for this batch.
            renderer: renders the frames of the video.
        """
        self.folders.append(folder)
        if not {"html", "mp4"} & {*self.options.formats}:
            return
        subject = exported_subject(batch, prediction, renderer, self.options)
        self._first = self._first or subject
        self._packed.append(pack(subject.gaussians, self._first.pixel, self._first.center, COARSE))
        points = subject.body if len(subject.body) else subject.center[None]
        self._means.append(points.mean(0).cpu().numpy())
        self._boxes.append(torch.stack((points.amin(0), points.amax(0))).cpu().numpy())

    def write(self, directory: Path) -> list[Path]:
        """Write the files, after all instants have been added and their own files written.

        Args:
            directory: the directory of all instants.

        Returns:
            The paths, that of the report last; empty if ``formats`` has no such file.

        Raises:
            InputError: a file that no earlier prediction wrote has one of the names.
        """
        self.count = len(self.folders)
        self.others = {name: made for name, made in self.others.items() if made}
        names = self.files
        if not names:
            return []
        for name in begin_files(directory, names):
            # Files of an earlier, longer sequence would be played, too.
            if name.startswith("sequence/"):
                (directory / name).unlink()
        contents = {name: partial(self.others.get, name) for name in self.others}
        contents |= {"viewer.html": self._page, "instants.mp4": self._video}
        sources = iter(self.folders)
        for name in names:
            if name in contents:
                write_file(directory / name, contents[name])
            else:
                write_atomically(directory / name, partial(_link, next(sources) / "gaussians.ply"))
        return end_files(directory, names, {"instants": [folder.name for folder in self.folders]})

    def _path(self) -> np.ndarray:
        """Translation [instants, 3] of page and video: the smoothed path of the subject's mean."""
        reach = self.options.fps // 2
        # Odd reflection at the ends keeps a steady walk steady.
        padded = np.pad(np.stack(self._means), ((reach, reach), (0, 0)), "reflect", reflect_type="odd")
        weights = np.hanning(2 * reach + 3)[1:-1]
        windows = np.lib.stride_tricks.sliding_window_view(padded, len(weights), axis=0)
        means = windows @ (weights / weights.sum())
        return means - means[0]

    def _page(self) -> bytes:
        name = self.folders[0].parent.name
        path = self._path().tolist()
        return page(self._first, name, self._packed, path, self.options.fps).encode()

    def _video(self) -> bytes:
        """Render the video, in which the camera swings by ``_SWING`` to each side once over all instants."""
        first = self._first
        cameras = self._first.cameras
        path = self._path()
        low, high = (np.stack(self._boxes) - path[:, None]).swapaxes(0, 1)
        sides = torch.from_numpy(np.stack((low.min(0), high.max(0)), 1)).to(cameras.extrinsics.device)
        turns = torch.arange(len(path), dtype=torch.float64) * (2 * math.pi / len(path))
        seen = orbit(cameras, _SWING * turns.sin(), torch.cartesian_prod(*sides))
        shifts = torch.from_numpy(path).to(seen.extrinsics)
        seen.extrinsics[:, :3, 3] -= (seen.extrinsics[:, :3, :3] @ shifts[..., None])[..., 0]
        larger = max(_VIDEO_SIDE / max(seen.height, seen.width), 1.0)
        seen = seen.resize(round(larger * seen.height), round(larger * seen.width))

        def picture(frame: int) -> np.ndarray:
            gaussians = unpack(self._packed[frame], first.pixel, first.center, COARSE, first.gaussians)
            # Large frames would show gaps otherwise.
            gaussians = smooth(gaussians, first.pixel).to(seen.extrinsics.device)
            return to_uint8(first.renderer(gaussians, seen[frame : frame + 1][None]).image[0, 0])

        return mp4_bytes(map(picture, range(len(path))), self.options.fps)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


# Players guess the colour matrix and range otherwise.
_COLORS = (
    "-vf scale=out_color_matrix=bt709:out_range=tv -colorspace bt709 -color_primaries bt709 -color_trc bt709"
)


def mp4_bytes(pictures: Iterable[np.ndarray], fps: int) -> bytes:
    """Encode frames as a video; odd sides are padded by one row or column.

    Args:
        pictures: [h, w, 3] uint8 of one size, at least one; consumed one by one, so that a long video
            fits in memory.
        fps: frames per second.

    Returns:
        The content of an MP4 file.
    """
    import imageio_ffmpeg

    pictures = iter(pictures)
    first = next(pictures)
    height, width = first.shape[:2]
    pad = ((0, height % 2), (0, width % 2), (0, 0))
    with TemporaryDirectory() as folder:
        path = Path(folder, "video.mp4")
        writer = imageio_ffmpeg.write_frames(
            str(path),
            (width + width % 2, height + height % 2),
            fps=fps,
            quality=8,
            macro_block_size=2,
            output_params=[*_COLORS.split(), "-movflags", "+faststart"],
        )
        writer.send(None)
        for picture in chain([first], pictures):
            writer.send(np.ascontiguousarray(np.pad(picture, pad, mode="edge")))
        writer.close()
        return path.read_bytes()
