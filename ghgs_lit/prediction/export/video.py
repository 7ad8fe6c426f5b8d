"""Pictures as an MP4 that browsers and phones play (H.264, 4:2:0, BT.709)."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

# RGB is told apart from video levels by these: a player that guesses the matrix shows other colours.
_COLORS = (
    "-vf scale=out_color_matrix=bt709:out_range=tv -colorspace bt709 -color_primaries bt709 -color_trc bt709"
)


def mp4_bytes(pictures: Sequence[np.ndarray], fps: int) -> bytes:
    """The content of a video of pictures [h, w, 3] uint8 of one size; odd sides get one more row or column.
    ``pictures``: at least one."""
    import imageio_ffmpeg

    height, width = pictures[0].shape[:2]
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
        for picture in pictures:
            writer.send(np.ascontiguousarray(np.pad(picture, pad, mode="edge")))
        writer.close()
        return path.read_bytes()
