"""Files that cover several instants: a page that plays them, and a video."""

import zlib
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from ghgs_capture.export.page import COARSE, pack, page
from ghgs_capture.export.reports import begin_files, end_files, write_file
from ghgs_capture.export.subject import ExportedSubject, OutputOptions, export_subject, smooth
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.visualization.pictures import to_uint8

_VIDEO_SIDE = 720  #: Least length of the longer side of the video's frames, in pixels


class Instants:
    """Files that cover all instants, next to the folders of the instants: for ``html`` ``viewer.html``,
    for ``mp4`` ``instants.mp4``. Their cameras follow the subject's mean.

    Args:
        options: formats, upward axis and frames per second.
    """

    def __init__(self, options: OutputOptions):
        self.options = options
        #: names of the files, relative to the directory of all instants
        self.files: list[str] = []
        for format, name in (("html", "viewer.html"), ("mp4", "instants.mp4")):
            if format in options.formats:
                self.files.append(name)
        self._folders: list[Path] = []
        self._first: ExportedSubject | None = None
        self._packed: list[bytes] = []
        self._frames: list[bytes] = []
        self._means: list[np.ndarray] = []

    def add(self, folder: Path, batch: Batch, prediction: Prediction, renderer: Renderer) -> None:
        """Add the next instant.

        Args:
            folder: the folder of this instant's own files.
            batch: photographs, masks and cameras of one subject.
            prediction: the prediction for this batch.
            renderer: renders the frame of the video.
        """
        self._folders.append(folder)
        if not self.files:
            return
        subject = export_subject(batch, prediction, renderer, self.options)
        self._first = first = self._first or subject
        points = subject.body if len(subject.body) else subject.center[None]
        mean = points.mean(0)
        self._means.append(mean.cpu().numpy())
        if "viewer.html" in self.files:
            self._packed.append(pack(subject.gaussians, first.pixel, first.center, COARSE))
        if "instants.mp4" in self.files:
            gaussians = smooth(subject.gaussians, first.pixel)  # large frames would show gaps otherwise
            shift = torch.from_numpy(self._means[0]).to(mean) - mean
            moved = replace(gaussians, means=gaussians.means + shift)
            camera = first.cameras[:1]
            larger = max(_VIDEO_SIDE / max(camera.height, camera.width), 1.0)
            camera = camera.resize(round(larger * camera.height), round(larger * camera.width))
            picture = to_uint8(renderer(moved, camera[None]).image[0, 0])
            self._frames.append(zlib.compress(picture.tobytes(), 1))
            self._shape = picture.shape

    def write(self, directory: Path) -> list[Path]:
        """Write the files, after all instants have been added.

        Args:
            directory: the directory of all instants.

        Returns:
            The paths, that of the report last; empty if ``formats`` has no such file.

        Raises:
            InputError: a file that no earlier prediction wrote has one of the names.
        """
        if not self.files:
            return []
        begin_files(directory, self.files)
        contents = {"viewer.html": self._page, "instants.mp4": self._video}
        for name in self.files:
            write_file(directory / name, contents[name])
        return end_files(directory, self.files, {"instants": [folder.name for folder in self._folders]})

    def _page(self) -> bytes:
        """The page, whose camera follows the subject's mean, smoothed over a second."""
        reach = self.options.fps // 2
        # Odd reflection at the ends keeps a steady walk steady.
        padded = np.pad(np.stack(self._means), ((reach, reach), (0, 0)), "reflect", reflect_type="odd")
        weights = np.hanning(2 * reach + 3)[1:-1]
        windows = np.lib.stride_tricks.sliding_window_view(padded, len(weights), axis=0)
        path = windows @ (weights / weights.sum())
        name = self._folders[0].parent.name
        return page(self._first, name, self._packed, (path - path[0]).tolist(), self.options.fps).encode()

    def _video(self) -> bytes:
        pictures = (np.frombuffer(zlib.decompress(frame), np.uint8) for frame in self._frames)
        return mp4_bytes((picture.reshape(self._shape) for picture in pictures), self.options.fps)


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
