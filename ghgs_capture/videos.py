"""Read videos of cameras: the time of each frame, and frames decoded on demand by ffmpeg."""

import functools
import io
import math
import re
import subprocess
import threading
import weakref
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ghgs_lit.errors import InputError, import_optional, require
from ghgs_lit.parsing import require_file

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm")
# Makes ffmpeg print the time of each frame to stderr before it writes the frame
_TELL = r"metadata=add:key=k:value=v,metadata=print:file='pipe\:2':direct=1"
_TIME = re.compile(rb"pts_time:(\S+)")
# Exact colours; by default green is one level too dark
_EXACT = "bicubic+accurate_rnd+full_chroma_int"
# How framecrc marks a packet without time, and one that is not shown
_UNTIMED = -(2**63)
_HIDDEN = re.compile("F=0x[4-7]")
# Transfer curves that ffmpeg does not convert to sRGB
_HDR = re.compile(r"Video: .*\b(arib-std-b67|smpte2084)\b")
_NAMES = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
_PATIENCE = 10.0  #: Seconds of a video that are decoded to reach a frame; ffmpeg seeks frames beyond


@dataclass(frozen=True)
class Video:
    """The frames of a video, as listed in its file."""

    path: Path
    size: tuple[int, int]  #: (height, width) in pixels as shown
    seconds: np.ndarray  #: [n] float64, time of each frame, ascending
    numbers: np.ndarray  #: [n] int64, number of each frame, counting dropped frames
    hdr: str = ""  #: HLG or PQ if colours follow this curve

    @property
    def count(self) -> int:
        """Number of frames, including those that the camera dropped."""
        return int(self.numbers[-1]) + 1

    @property
    def rate(self) -> float:
        """Frames per second; 1 if there is only one frame."""
        length = max(float(self.seconds[-1] - self.seconds[0]), 1e-6)
        return (self.count - 1) / length if self.count > 1 else 1.0

    def number_at(self, seconds: float) -> int | None:
        """Number of the frame at a time.

        Args:
            seconds: time on the clock of :attr:`seconds`.

        Returns:
            The number; None without a frame within half a frame time.
        """
        away = np.abs(self.seconds - seconds)
        place = int(away.argmin())
        return int(self.numbers[place]) if away[place] < 0.5 / self.rate else None


def read_video(path: Path) -> Video:
    """List the frames of a video; only the first one is decoded.

    Raises:
        InputError: the file is missing, cannot be read by ffmpeg or has no frames, or ffmpeg is not
            installed.
    """
    require_file(path, "a video")
    return _read_video(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=256)
def _read_video(path: Path, changed: int) -> Video:
    """:func:`read_video`, cached by the modification time ``changed``."""
    options = ("-frames:v", "1", "-f", "image2pipe", "-c:v", "pgm")
    first = subprocess.run(_command(path, "gray", *options, log="error"), capture_output=True)
    time = _TIME.search(first.stderr)
    listing = [*_source(path, log="info"), "-c", "copy", "-f", "framecrc", "-"]
    copied = subprocess.run(listing, capture_output=True)
    listed = copied.stdout.decode().splitlines()
    hdr = _HDR.search(copied.stderr.decode(errors="replace"))
    packets = [line.split(",")[1:3] for line in listed if line[:1].isdigit() and not _HIDDEN.search(line)]
    if time is None or not packets:
        last_line = first.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no output of ffmpeg"]
        raise InputError(f"{path}: expected a video with frames that ffmpeg can decode; found {last_line[0]}")
    decoded, shown = np.array(packets, np.int64).T
    unit = next(Fraction(line.split(":")[1].strip()) for line in listed if line.startswith("#tb"))
    is_timed = shown.min() > _UNTIMED
    seconds = np.sort(shown if is_timed else decoded) * float(unit)
    if not is_timed:  # packets of AVI are in decoding order: frames are shown later
        seconds += float(time[1]) - seconds[0]
    steps = np.diff(seconds)
    usual = max(float(np.median(steps)), 1e-6) if len(steps) else 1.0
    numbers = np.cumsum([0, *np.rint(steps / usual).clip(1)]).astype(np.int64)
    size = Image.open(io.BytesIO(first.stdout), formats=["PPM"]).size[::-1]
    return Video(path, size, seconds, numbers, _NAMES[hdr[1]] if hdr else "")


def _source(path: Path, seek: float = 0.0, log: str = "quiet") -> list[str]:
    ffmpeg = import_optional("imageio_ffmpeg", "video", str(path)).get_ffmpeg_exe()
    start = ["-ss", f"{seek:.6f}"] if seek > 0 else []
    return [ffmpeg, "-v", log, "-nostdin", "-copyts", *start, "-i", str(path), "-map", "0:v:0"]


def _command(path: Path, pixels: str, *output: str, select: str = "1", **source: Any) -> list[str]:
    filters = ["-vf", f"select='{select}',{_TELL}", "-sws_flags", _EXACT, "-fps_mode", "passthrough"]
    return [*_source(path, **source), *filters, "-pix_fmt", pixels, *output, "-"]


class Reader:
    """Decoder of one video's frames, fastest in ascending order; other frames require a seek.

    Args:
        video: the video from :func:`read_video`.
        pixels: pixel format: ``rgb24`` | ``gray``.
        step: distance between requested frames; ffmpeg drops the others.
    """

    def __init__(self, video: Video, pixels: str, step: int = 1) -> None:
        self.video = video
        self.pixels = pixels
        self.step = step
        self._lock = threading.Lock()
        self._process = None
        # Numbers of the current frame and of the previous one; no frame between them can be decoded.
        self._at = self._before = -1
        self._frame = np.zeros(0, np.uint8)

    def frame(self, number: int) -> np.ndarray:
        """Decode a frame.

        Args:
            number: number of the frame, counting dropped frames.

        Returns:
            [h, w, 3] or, with ``gray``, [h, w] uint8; read-only.

        Raises:
            InputError: there is no such frame, or it cannot be decoded.
        """
        far = _PATIENCE * self.video.rate + self.step
        with self._lock:
            if self._process is None or number <= self._before or number > self._at + far:
                self._open(number)
            while self._at < number and self._advance():
                pass
            expected = f"a frame {number} that ffmpeg can decode"
            require(self._at == number, str(self.video.path), expected, "none")
            return self._frame

    def _open(self, number: int) -> None:
        """Start ffmpeg one second before a frame."""
        video = self.video
        select = "1"
        place = min(np.searchsorted(video.numbers, number), len(video.numbers) - 1)
        time = float(video.seconds[place])
        length = 1 / video.rate
        uneven = np.abs(video.seconds - video.seconds[0] - video.numbers * length).max()
        if self.step > 1 and uneven < length / 4:
            select = f"lt(mod(t-{time - length / 2:.6f},{self.step * length:.9f}),{length:.6f})"
        seek = time - float(video.seconds[0]) - 1.0
        if self._process is not None:
            self._end()
        command = _command(video.path, self.pixels, "-f", "rawvideo", select=select, seek=seek)
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        self._end = weakref.finalize(self, _stop, self._process)
        self._at = self._before = number - 1

    def _advance(self) -> bool:
        """Read the next frame from ffmpeg; false at the end."""
        shape = (*self.video.size, 3) if self.pixels == "rgb24" else self.video.size
        time = next(filter(None, map(_TIME.search, self._process.stderr)), None)
        content = self._process.stdout.read(math.prod(shape))
        if time is None or len(content) < math.prod(shape):
            return False
        number = self.video.number_at(float(time[1]))
        if number is not None and number > self._at:
            self._before = self._at
            self._at = number
            self._frame = np.frombuffer(content, np.uint8).reshape(shape)
        return True


def _stop(process: subprocess.Popen) -> None:
    process.kill()
    process.communicate()
