"""Predict a batch made by hand from rendered people, with any checkpoint, and render it.

python examples/predict_batch.py rendered runs/mine/checkpoints/last.ckpt
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from ghgs_lit import Batch, Cameras, Predictor, render
from ghgs_lit.ply import write_ply

# four photographs of the first person in ``val``
folder = Path(sys.argv[1]) / "val"
person = sorted(path.name for path in (folder / "img").glob("*_000"))[0].removesuffix("_000")
names = [f"{person}_{position:03d}/0" for position in (0, 4, 8, 12)]
images = torch.stack([torch.tensor(np.array(Image.open(folder / "img" / f"{n}.jpg"))) for n in names])
masks = torch.stack([torch.tensor(np.array(Image.open(folder / "mask" / f"{n}.png"))) > 0 for n in names])
if masks.dim() == 4:  # masks of three channels
    masks = masks[..., 0]

# K [3, 3] in pixels, pixel centres at +0.5 (add 0.5 to cx and cy of a calibration made with OpenCV);
# world to camera [4, 4], OpenCV axes, any unit; float64 where the world's origin is far away.
intrinsics = torch.tensor(np.stack([np.load(folder / "parm" / f"{n}_intrinsic.npy") for n in names])).float()
extrinsics = torch.eye(4).repeat(len(names), 1, 1)
for i, n in enumerate(names):
    extrinsics[i, :3] = torch.tensor(np.load(folder / "parm" / f"{n}_extrinsic.npy"))[:3]

height, width = masks.shape[1:]  # multiples of 14, or a model with model.pad=multiple
cameras = Cameras(intrinsics[None], extrinsics[None], height, width)  # [1, V, ...]: a batch of one person
# [1, V, 3, H, W] in 0..1, on black
photographs = images.permute(0, 3, 1, 2)[None] / 255 * masks[None, :, None]
batch = Batch(images=photographs, masks=masks[None], cameras=cameras)

predictor = Predictor.from_checkpoint(sys.argv[2])
with torch.inference_mode():  # torch.no_grad() where a gradient will be taken of the result
    prediction = predictor(batch)  # .gaussians, .depth, .points
write_ply(prediction.gaussians, Path("person.ply"))
# from any Cameras [1, T]: .image [1, T, 3, H, W], .alpha, .depth
rendering = render(prediction.gaussians, cameras)
picture = rendering.image[0, 0].permute(1, 2, 0).clamp(0, 1) * 255
Image.fromarray(picture.byte().numpy()).save("person.png")
