"""Pictures as an MP4 that browsers and phones play (H.264, 4:2:0, BT.709)."""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

# RGB is told apart from video levels by these: a player that guesses the matrix shows other colours.
_COLORS = (
    "-vf scale=out_color_matrix=bt709:out_range=tv -colorspace bt709 -color_primaries bt709 -color_trc bt709"
)


def mp4_bytes(pictures: Iterable[np.ndarray], fps: int) -> bytes:
    """The content of a video of pictures [h, w, 3] uint8 of one size; odd sides get one more row or column.
    ``pictures``: at least one; they are taken one after another, so that a long video fits in memory."""
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
