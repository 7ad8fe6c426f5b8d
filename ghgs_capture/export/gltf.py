"""Gaussians as binary glTF with the Khronos extension ``KHR_gaussian_splatting``.

The vertices are in the world of the other files; a node turns it so that +y is up, as in glTF.
Programs without the extension show coloured points."""

import numpy as np
import torch

from ghgs_capture.export.compact import rgba
from ghgs_capture.export.subject import AXES, turn
from ghgs_lit.errors import require
from ghgs_lit.ply import SH_CONSTANT, stored_values
from ghgs_lit.types import Gaussians

EXTENSION = "KHR_gaussian_splatting"
_KERNEL = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "sortingMethod": "zDepth",
    "projection": "perspective",
}


def glb_bytes(gaussians: Gaussians, up: torch.Tensor) -> bytes:
    """Store Gaussians as binary glTF (Khronos extension ``KHR_gaussian_splatting``).

    Args:
        gaussians: of one subject, with RGB colours.
        up: the world's upward unit vector [3].

    Returns:
        The content of a file.

    Raises:
        InputError: there are no Gaussians (glTF has no empty lists).
    """
    import pygltflib as gltf

    require(len(gaussians) > 0, "formats=glb", "at least one Gaussian", 0)
    stored = stored_values(gaussians)
    columns = {
        "POSITION": stored["means"],
        "COLOR_0": rgba(stored),
        f"{EXTENSION}:ROTATION": stored["quaternions"][:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": stored["scales"],
        f"{EXTENSION}:OPACITY": stored["opacities"].clamp(0, 1),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (stored["colors"] - 0.5) / SH_CONSTANT,
    }
    model = gltf.GLTF2(scene=0, scenes=[gltf.Scene(nodes=[0])])
    blob = b""
    for name, values in columns.items():
        data = np.ascontiguousarray(values.numpy()).tobytes()
        span = {"byteOffset": len(blob), "byteLength": len(data)}
        model.bufferViews.append(gltf.BufferView(buffer=0, **span, target=gltf.ARRAY_BUFFER))
        is_bytes = values.dtype == torch.uint8
        accessor = gltf.Accessor(
            bufferView=len(model.bufferViews) - 1,
            componentType=gltf.UNSIGNED_BYTE if is_bytes else gltf.FLOAT,
            normalized=is_bytes,
            count=len(values),
            type="SCALAR" if values.dim() == 1 else f"VEC{values.shape[1]}",
        )
        if name == "POSITION":
            accessor.min = values.amin(0).tolist()
            accessor.max = values.amax(0).tolist()
        model.accessors.append(accessor)
        blob += data
    attributes = gltf.Attributes(**{name: index for index, name in enumerate(columns)})
    primitive = gltf.Primitive(attributes=attributes, mode=gltf.POINTS, extensions={EXTENSION: _KERNEL})
    w, x, y, z = turn(up.cpu(), torch.tensor(AXES["y"])).tolist()
    model.nodes = [gltf.Node(mesh=0, rotation=[x, y, z, w])]
    model.meshes = [gltf.Mesh(primitives=[primitive])]
    model.extensionsUsed = [EXTENSION]
    model.buffers = [gltf.Buffer(byteLength=len(blob))]
    model.set_binary_blob(blob)
    return b"".join(model.save_to_bytes())
