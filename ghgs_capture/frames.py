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
from ghgs_capture.masks import fitted
from ghgs_capture.photographs import (
    MASK_ENDING,
    Pixels,
    by_camera,
    camera_named,
    image_named,
    images_in,
    require_all_read,
)
from ghgs_capture.videos import SUFFIXES, Reader, Video, read_video
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import normalize_name, read_rows
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
    mask: "VideoFrame | Path | None" = None

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
        return fitted(exact, pixels, self.video.video.path)


Source = Path | VideoFrame  #: Where a photograph comes from


def has_videos(folder: Path, cameras: Mapping[str, StoredCamera], names: Mapping[str, str]) -> bool:
    """Whether a folder without photographs contains a camera's video, or videos and no folders.

    Args:
        folder: the folder.
        cameras: cameras by name.
        names: cameras of videos with other names.
    """
    if not folder.is_dir() or images_in(folder):
        return False
    videos = images_in(folder, SUFFIXES)
    is_known = any(camera_named(name, cameras, names) in cameras for name in videos)
    return is_known or (bool(videos) and not any(path.is_dir() for path in folder.iterdir()))


def find_frames(
    folder: Path,
    masks: Path | None,
    cameras: Mapping[str, StoredCamera],
    names: Mapping[str, str],
    convention: Convention,
    sync: Mapping[str, int] | str | None,
    step: int,
) -> dict[str, dict[str, VideoFrame]]:
    """Find the frames of each instant that all videos show; warns if the videos differ in length.

    Args:
        folder: folder of videos, each named after its camera.
        masks: folder of masks, with a video or a folder of numbered images of the same name for each
            video; None: videos in ``folder`` whose names end with ``_mask``, if any.
        cameras: cameras by name.
        names: cameras of videos with other names.
        convention: convention of the cameras' numbers, for checking the sizes of videos.
        sync: number of frames by which each camera started before the others; or path of a CSV
            ``camera,frame,seconds``, with which each frame of the first camera is matched with the
            nearest ones of the others; None: all started together.
        step: step between the instants that will be read, 1 or more; ignored with a CSV.

    Returns:
        ``{instant: {camera: frame}}``, instants named after the first camera's frame number.

    Raises:
        InputError: videos do not fit the cameras or one another.
    """
    paths_by_name = images_in(folder, SUFFIXES)
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
    if isinstance(sync, str):
        numbers = _by_time(videos, Path(sync).expanduser(), names)
        step = 1
    else:
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
    expected = "as many frames a second of all, or the path of a CSV with camera,frame,seconds"
    require(drift < 0.5, "sequence.sync", expected, rates)
    first = next(iter(videos))
    shift = {name: offsets.get(name, 0) - offsets.get(first, 0) for name in videos}
    begin = max(-n for n in shift.values())
    end = min(video.count - shift[name] for name, video in videos.items())
    require(begin < end, "sequence.sync", "frames that all videos show", dict(offsets))
    numbers = {}
    for number in range(begin, end):
        numbers[number] = {name: number + n for name, n in shift.items()}
    return numbers


def _by_time(videos: Mapping[str, Video], path: Path, names: Mapping[str, str]) -> dict[int, dict[str, int]]:
    """Frame of each camera that is nearest to each of the first camera's, within half a frame time."""
    import pandas as pd  # here: slow to import

    columns = {"camera": str, "frame": int, "seconds": float}
    rows = read_rows(path)
    try:
        table = pd.DataFrame(rows, columns=list(columns)).astype(columns)
        if not np.isfinite(table.seconds).all():
            raise ValueError("no time")
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: expected camera,frame,seconds with numbers; found {error}") from None
    cameras = table.camera.map(lambda name: names.get(normalize_name(name), normalize_name(name)))
    times = {name: timed.sort_values("seconds") for name, timed in table.groupby(cameras)}
    require(times.keys() == videos.keys(), str(path), f"the times of {', '.join(videos)}", ", ".join(times))
    first, *others = videos
    steps = times[first].seconds.diff().dropna()
    half = float(steps.median()) / 2 if len(steps) else np.inf
    begin = max(timed.seconds.iloc[0] for timed in times.values()) - half
    end = min(timed.seconds.iloc[-1] for timed in times.values()) + half
    shared = times[first][times[first].seconds.between(begin, end)][["seconds", "frame"]]
    require(len(shared) > 0, str(path), "times that all cameras share", "none")
    shared = shared.rename(columns={"frame": first})
    for other in others:
        timed = times[other][["seconds", "frame"]].rename(columns={"frame": other})
        shared = pd.merge_asof(shared, timed, on="seconds", direction="nearest", tolerance=half)
    numbers = {}
    for entry in shared.drop(columns="seconds").to_dict("records"):
        # A camera without a frame at this time has NaN.
        numbers[entry[first]] = {name: int(n) for name, n in entry.items() if n == n}
    return numbers


def _masks_of(video: Video, folder: Path, masks: Path | None, step: int) -> dict[int, VideoFrame | Path]:
    """Masks of a video by frame number, from a video of masks or numbered images; raises InputError if
    ``masks`` is given and lacks them, or if they are not numbered like the frames."""
    name = normalize_name(video.path.stem)
    place = folder if masks is None else masks
    marked = f"{name}{MASK_ENDING}"
    names = (marked,) if os.path.realpath(place) == os.path.realpath(folder) else (name, marked)
    path = image_named(place, *names, suffixes=SUFFIXES)
    if path is not None:
        drawn = read_video(path)
        reader = Reader(drawn, "gray", step)
        numbers = drawn.numbers.tolist()
        # Masks made frame by frame do not count the frames that the camera dropped.
        known = video.numbers.tolist() if len(numbers) == len(video.numbers) else numbers
        return {n: VideoFrame(reader, its) for n, its in zip(known, numbers, strict=True)}
    if masks is None:
        return {}
    below = next((place / spelled for spelled in names if (place / spelled).is_dir()), None)
    require(below is not None, str(masks), f"a video {name} or a folder of it", "none")
    return _numbered(below, video)


def _numbered(folder: Path, video: Video) -> dict[int, Path]:
    """Images by frame number, which programs count from 0 or from 1."""
    digits = {"".join(filter(str.isdigit, name)): path for name, path in images_in(folder).items()}
    numbered = {int(number): path for number, path in digits.items() if number}
    if len(numbered) == len(video.numbers):
        return dict(zip(video.numbers.tolist(), (numbered[n] for n in sorted(numbered)), strict=True))
    from_one = video.count in numbered
    expected = f"masks numbered from 0 to {video.count - 1} or from 1 to {video.count}"
    require(from_one != (0 in numbered), str(folder), expected, f"{len(numbered)} masks")
    return {number - from_one: path for number, path in numbered.items()}
