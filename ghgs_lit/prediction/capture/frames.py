"""Frames of a folder with one video for each camera, by instant."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ghgs_lit.errors import InputError, require
from ghgs_lit.kernels.cores import allowed_cores
from ghgs_lit.prediction.capture.calibration import Convention, StoredCamera, calibrate
from ghgs_lit.prediction.capture.masks import matte_of_file
from ghgs_lit.prediction.capture.photographs import (
    MASK_ENDING,
    Pixels,
    by_camera,
    composed,
    image_named,
    images_in,
)
from ghgs_lit.prediction.capture.videos import SUFFIXES, Reader, Video, nearest, read_video
from ghgs_lit.readers import read_rows

# Coding changes black and white by less than this.
_CODED = 16
_DIGITS = 6


@dataclass(frozen=True)
class VideoFrame:
    """A photograph that is a frame of a video; its mask is one, too, or a file, or elsewhere (None)."""

    video: Reader
    number: int
    masks: Reader | Mapping[int, Path] | None

    def __str__(self) -> str:
        return f"{self.video.video.path}, frame {self.number}"

    def pixels(self) -> Pixels:
        """The frame. InputError: it cannot be decoded."""
        return Pixels(self.video.frame(self.number), None, 0)

    def matte(self, pixels: Pixels) -> np.ndarray:
        """[h, w] uint8, where ``masks`` has it. InputError: it is missing or has another size."""
        if isinstance(self.masks, Reader):
            known, drawn = self.video.video.numbers, self.masks.video.numbers
            # Masks that were drawn of frame after frame know of none that the camera dropped.
            number = (
                self.number if len(known) != len(drawn) else int(drawn[np.searchsorted(known, self.number)])
            )
            grey, place = self.masks.frame(number), str(self.masks.video.path)
            expected = f"the size of its video, {pixels.size} (height, width)"
            require(grey.shape == pixels.size, place, expected, grey.shape)
            return np.where(grey < _CODED, 0, np.where(grey > 255 - _CODED, 255, grey)).astype(np.uint8)
        path = self.masks.get(self.number)
        require(path is not None, str(self), "a mask of this number", "none")
        return matte_of_file(path, pixels)


def has_videos(folder: Path, cameras: Mapping[str, StoredCamera], names: Mapping[str, str]) -> bool:
    """Whether a folder is one of videos: it holds one of a camera, or nothing else."""
    if not folder.is_dir() or images_in(folder):
        return False
    videos = images_in(folder, SUFFIXES)
    is_known = any(names.get(name, name) in cameras for name in videos)
    return is_known or (bool(videos) and not any(path.is_dir() for path in folder.iterdir()))


def find_frames(
    folder: Path,
    masks: Path | None,
    cameras: Mapping[str, StoredCamera],
    names: Mapping[str, str],
    convention: Convention,
    sync: Mapping[str, int] | str | None,
    step: int,
) -> tuple[dict[str, dict[str, VideoFrame]], str]:
    """The frames of each instant that all videos show.

    Args:
        masks: folder of masks: a video of the same name for each, or a folder of numbered images; None:
            videos beside the others that end with ``_mask``, where there are any.
        sync: frames by which a camera began before the others; or a CSV of ``camera,frame,seconds``, by which
            each frame of the first camera gets the nearest one of every other; None: all began together.
        step: of the instants that will be read.

    Returns:
        ``{instant: {camera: frame}}``, instants named by the frame of the first camera; and a line about
        frames that are left over.

    Raises:
        InputError: videos and cameras, or videos and one another, do not fit together.
    """
    paths = by_camera(folder, images_in(folder, SUFFIXES), cameras, names)
    with ThreadPoolExecutor(allowed_cores()) as pool:
        videos = dict(zip(paths, pool.map(read_video, paths.values()), strict=True))
    for name, video in videos.items():
        try:
            calibrate(cameras[name], convention, video.size)
        except InputError as error:
            raise InputError(f"{video.path}: {error}") from None
    if isinstance(sync, str):
        numbers, step = _by_time(videos, Path(sync).expanduser(), names), 1
    else:
        numbers = _by_number(videos, {names.get(str(key), str(key)): n for key, n in (sync or {}).items()})
    counts = ", ".join(f"{name} {video.count}" for name, video in videos.items())
    differ = len({video.count for video in videos.values()}) > 1
    note = f"videos differ in length ({counts} frames): the {len(numbers)} instants that all show are used"
    readers = {name: Reader(video, "rgb24", step) for name, video in videos.items()}
    mattes = {name: _masks_of(video, folder, masks, step) for name, video in videos.items()}
    known = {name: set(video.numbers.tolist()) for name, video in videos.items()}
    instants = {
        f"{instant:0{_DIGITS}d}": {
            name: VideoFrame(readers[name], number, mattes[name])
            for name, number in shown.items()
            if number in known[name]
        }
        for instant, shown in numbers.items()
    }
    return instants, note if differ else ""


def _by_number(videos: Mapping[str, Video], offsets: Mapping[str, Any]) -> dict[int, dict[str, int]]:
    """The frame of each camera, by that of the first."""
    unknown = sorted(set(offsets) - set(videos))
    require(not unknown, "sequence.sync", f"cameras among {', '.join(videos)}", unknown)
    wrong = {name: value for name, value in offsets.items() if type(value) is not int}
    require(not wrong, "sequence.sync", "whole numbers of frames", wrong)
    rates = {name: round(video.rate, 4) for name, video in videos.items() if video.count > 1}
    length = min(video.count for video in videos.values())
    drift = (max(rates.values(), default=1) / min(rates.values(), default=1) - 1) * length
    expected = "as many frames a second of all, or the path of a CSV with camera,frame,seconds"
    require(drift < 0.5, "sequence.sync", expected, rates)
    first = next(iter(videos))
    shift = {name: offsets.get(name, 0) - offsets.get(first, 0) for name in videos}
    begin = max(-n for n in shift.values())
    end = min(video.count - shift[name] for name, video in videos.items())
    require(begin < end, "sequence.sync", "frames that all videos show", dict(offsets))
    return {number: {name: number + n for name, n in shift.items()} for number in range(begin, end)}


def _by_time(videos: Mapping[str, Video], path: Path, names: Mapping[str, str]) -> dict[int, dict[str, int]]:
    """The frame of each camera that is nearest to one of the first, within half of the time between its."""
    times: dict[str, list[tuple[float, int]]] = {}
    for row in read_rows(path):
        try:
            name = composed(row["camera"])
            entry = float(row["seconds"]), int(row["frame"])
            if not np.isfinite(entry[0]):
                raise ValueError("no time")
            times.setdefault(names.get(name, name), []).append(entry)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}: expected camera,frame,seconds with numbers; found {row} ({error!r})"
            ) from None
    for name in videos:
        require(name in times, str(path), f"the times of {', '.join(videos)}", ", ".join(times) or "none")
    unknown = sorted(set(times) - set(videos))
    require(not unknown, str(path), f"cameras among {', '.join(videos)}", unknown)
    seconds = {name: np.array(sorted(times[name])) for name in videos}
    first, *others = videos
    half = float(np.median(np.diff(seconds[first][:, 0]))) / 2 if len(seconds[first]) > 1 else np.inf
    begin, end = (f([table[i, 0] for table in seconds.values()]) for f, i in ((max, 0), (min, -1)))
    common = seconds[first][(seconds[first][:, 0] >= begin - half) & (seconds[first][:, 0] <= end + half)]
    require(len(common) > 0, str(path), "times that all cameras share", "none")
    found = {int(frame): {first: int(frame)} for frame in common[:, 1]}
    for other in others:
        rows = seconds[other][nearest(seconds[other][:, 0], common[:, 0])]
        for (time, instant), (near, frame) in zip(common, rows, strict=True):
            if abs(near - time) <= half:
                found[int(instant)][other] = int(frame)
    return found


def _masks_of(video: Video, folder: Path, masks: Path | None, step: int) -> Reader | dict[int, Path] | None:
    """Where the masks of a video are."""
    name, place = composed(video.path.stem), folder if masks is None else masks
    marked = f"{name}{MASK_ENDING}"
    names = (marked,) if place.resolve() == folder.resolve() else (name, marked)
    path = image_named(place, *names, suffixes=SUFFIXES)
    if path is not None:
        return Reader(read_video(path), "gray", step)
    if masks is None:
        return None
    below = next((place / spelled for spelled in names if (place / spelled).is_dir()), None)
    require(below is not None, str(masks), f"a video {name} or a folder of it", "none")
    return _numbered(below, video)


def _numbered(folder: Path, video: Video) -> dict[int, Path]:
    """Images by the number of their frame; programs count them from 0 or from 1."""
    digits = {"".join(filter(str.isdigit, name)): path for name, path in images_in(folder).items()}
    numbered = {int(number): path for number, path in digits.items() if number}
    if len(numbered) == len(video.numbers):
        return dict(zip(video.numbers.tolist(), (numbered[n] for n in sorted(numbered)), strict=True))
    from_one = video.count in numbered
    expected = f"masks numbered from 0 to {video.count - 1} or from 1 to {video.count}"
    require(from_one != (0 in numbered), str(folder), expected, f"{len(numbered)} masks")
    return {number - from_one: path for number, path in numbered.items()}
