"""Photographs of a person to a splat.

python examples/photographs_to_splat.py photographs cameras.json model.ckpt splat.ply

Masks lie next to the photographs (``front_mask.png`` of ``front.jpg``), or are their alpha channels.
"""

import sys

from ghgs_capture import Capture, predict
from ghgs_lit.ply import write_ply

images, cameras, checkpoint, splat = sys.argv[1:]
capture = Capture.read(images, cameras)
prediction = predict(capture, checkpoint)
write_ply(prediction.gaussians, splat)
print(f"{splat}: {len(prediction.gaussians)} Gaussians")
