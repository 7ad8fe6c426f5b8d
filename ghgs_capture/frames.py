"""Group the frames of a folder with one video per camera by instant."""

import os
import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_capture.calibration import Convention, StoredCamera, calibrate
from ghgs_capture.masks import fit_to_photograph
from ghgs_capture.photographs import (
    MASK_ENDING,
    Pixels,
    by_camera,
    find_camera,
    find_image,
    list_images,
    require_all_read,
)
from ghgs_capture.videos import SUFFIXES, Reader, Video, read_video
from ghgs_lit.errors import require
from ghgs_lit.parsing import normalize_name
from ghgs_lit.runtime.cores import allowed_cores

# Video coding changes black and white by less than this
_CODED = 16
_DIGITS = 6
_TO_SRGB = "zscale=t=linear:npl={},format=gbrpf32le,zscale=p=bt709:t=iec61966-2-1:m=bt709:r=tv,format=yuv420p"


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """A video frame that is a photograph, with its ``mask`` if known, or a mask."""

    video: Reader
    number: int
    mask: "VideoFrame | None" = None

    def __str__(self) -> str:
        return f"{self.video.video.path}, frame {self.number}"

    def pixels(self) -> Pixels:
        """Decode the frame as a photograph.

        Raises:
            InputError: the frame cannot be decoded.
        """
        return Pixels(self.video.frame(self.number), None, 0)

    def matte(self, pixels: Pixels) -> np.ndarray:
        """Decode the frame as the mask of a photograph.

        Args:
            pixels: the photograph.

        Returns:
            [h, w] uint8; black and white are exact, although video coding changes them.

        Raises:
            InputError: the frame cannot be decoded, or has another aspect ratio.
        """
        grey = self.video.frame(self.number)
        exact = np.where(grey < _CODED, 0, np.where(grey > 255 - _CODED, 255, grey)).astype(np.uint8)
        return fit_to_photograph(exact, pixels, self.video.video.path)


Source = Path | VideoFrame  #: Where a photograph comes from


def has_videos(folder: Path, cameras: Mapping[str, StoredCamera], names: Mapping[str, str]) -> bool:
    """Whether a folder without photographs contains a camera's video, or videos and no folders.

    Args:
        folder: the folder.
        cameras: cameras by name.
        names: cameras of videos with other names.
    """
    if not folder.is_dir() or list_images(folder):
        return False
    videos = list_images(folder, SUFFIXES)
    is_known = any(find_camera(name, cameras, names) in cameras for name in videos)
    return is_known or (bool(videos) and not any(path.is_dir() for path in folder.iterdir()))


def find_frames(
    folder: Path,
    masks: Path | None,
    cameras: Mapping[str, StoredCamera],
    names: Mapping[str, str],
    convention: Convention,
    sync: Mapping[str, int] | None,
    step: int,
) -> dict[str, dict[str, VideoFrame]]:
    """Find the frames of each instant that all videos show; warns if the videos differ in length.

    Args:
        folder: folder of videos, each named after its camera.
        masks: folder of videos of masks, named like the videos; None: videos in ``folder`` whose names
            end with ``_mask``, if any.
        cameras: cameras by name.
        names: cameras of videos with other names.
        convention: convention of the cameras' numbers, for checking the sizes of videos.
        sync: number of frames by which each camera started before the others; None: all started
            together.
        step: step between the instants that will be read, 1 or more.

    Returns:
        ``{instant: {camera: frame}}``, instants named after the first camera's frame number.

    Raises:
        InputError: videos do not fit the cameras or one another.
    """
    paths_by_name = list_images(folder, SUFFIXES)
    require_all_read(folder, paths_by_name, {*cameras, *names}, SUFFIXES)
    paths = by_camera(folder, paths_by_name, cameras, names)
    with ThreadPoolExecutor(allowed_cores()) as pool:
        videos = dict(zip(paths, pool.map(read_video, paths.values()), strict=True))
    for name, video in videos.items():
        camera = cameras[name]
        filters = _TO_SRGB.format(100 if video.hdr == "HLG" else 203)
        expected = f"colours of standard range (ffmpeg -i {video.path.name} -vf {filters} ...)"
        require(not video.hdr, str(video.path), expected, video.hdr)
        calibrate(replace(camera, origin=f"{video.path}: {camera.origin}"), convention, video.size)
    numbers = _by_number(videos, {names.get(str(key), str(key)): n for key, n in (sync or {}).items()})
    frames = {}
    for name, video in videos.items():
        reader = Reader(video, "rgb24", step)
        drawn = _masks_of(video, folder, masks, step)
        frames[name] = {n: VideoFrame(reader, n, drawn.get(n)) for n in video.numbers.tolist()}
    instants = {}
    for instant, shown in numbers.items():
        decodable = {name: frames[name][n] for name, n in shown.items() if n in frames[name]}
        instants[f"{instant:0{_DIGITS}d}"] = decodable
    counts = {name: video.count for name, video in videos.items()}
    if len(set(counts.values())) > 1:
        warnings.warn(f"videos differ in length: {len(numbers)} instants of frames {counts}", stacklevel=2)
    return instants


def _by_number(videos: Mapping[str, Video], offsets: Mapping[str, Any]) -> dict[int, dict[str, int]]:
    """Frame number of each camera, by that of the first camera."""
    unknown = sorted(set(offsets) - set(videos))
    require(not unknown, "sequence.sync", f"cameras among {', '.join(videos)}", unknown)
    wrong = {name: value for name, value in offsets.items() if type(value) is not int}
    require(not wrong, "sequence.sync", "whole numbers of frames", wrong)
    rates = {name: round(video.rate, 4) for name, video in videos.items() if video.count > 1}
    length = min(video.count for video in videos.values())
    drift = (max(rates.values(), default=1) / min(rates.values(), default=1) - 1) * length
    require(drift < 0.5, "sequence.sync", "as many frames a second of all videos", rates)
    first = next(iter(videos))
    shift = {name: offsets.get(name, 0) - offsets.get(first, 0) for name in videos}
    begin = max(-n for n in shift.values())
    end = min(video.count - shift[name] for name, video in videos.items())
    require(begin < end, "sequence.sync", "frames that all videos show", dict(offsets))
    numbers = {}
    for number in range(begin, end):
        numbers[number] = {name: number + n for name, n in shift.items()}
    return numbers


def _masks_of(video: Video, folder: Path, masks: Path | None, step: int) -> dict[int, VideoFrame]:
    """Masks of a video by frame number; raises InputError if ``masks`` is given and lacks them."""
    name = normalize_name(video.path.stem)
    place = folder if masks is None else masks
    marked = f"{name}{MASK_ENDING}"
    names = (marked,) if os.path.realpath(place) == os.path.realpath(folder) else (name, marked)
    path = find_image(place, *names, suffixes=SUFFIXES)
    require(path is not None or masks is None, str(masks), f"a video {name}", "none")
    if path is None:
        return {}
    drawn = read_video(path)
    reader = Reader(drawn, "gray", step)
    numbers = drawn.numbers.tolist()
    # Masks made frame by frame do not count the frames that the camera dropped.
    known = video.numbers.tolist() if len(numbers) == len(video.numbers) else numbers
    return {n: VideoFrame(reader, its) for n, its in zip(known, numbers, strict=True)}
