"""Small files of published weights, with the published names."""

import gzip
import json
from functools import cache
from pathlib import Path

import torch
from omegaconf import OmegaConf
from safetensors.torch import save_file

from ghgs_lit.cli.weights import MODEL_NODES, empty_state
from ghgs_lit.config import compose
from ghgs_lit.method.model import GHGS
from ghgs_lit.weights import published

with gzip.open(Path(__file__).parents[1] / "fixtures" / "published_keys.json.gz") as file:
    PUBLISHED = json.load(file)

TINY = ["encoder.width=32", "encoder.heads=2", "encoder.depth=4", "encoder.layers=[0,1,2,3]"]
TINY += ["encoder.vit.depth=2", "encoder.vit.heads=2", "encoder.image_size=56"]

#: Some tensors of VGGT-1B outside the aggregator and the depth head.
OTHER_HEADS = {"camera_head.pose.weight": (9, 4), "point_head.norm.bias": (8,), "track_head.x.bias": (2,)}


def config(*overrides, tiny=True):
    """The configuration nodes of the model in ``ghgs import``, tiny or of the published size."""
    return json.loads(_composed((*(TINY if tiny else ()), *overrides)))


@cache
def _composed(overrides):
    composed = compose("import", overrides)
    nodes = [key for key in MODEL_NODES if key in composed]
    return json.dumps({key: OmegaConf.to_container(composed[key], resolve=True) for key in nodes})


def import_weights(config, out, vggt, release=None, *args, **kwargs):
    """Import weights as the verb does; return the report."""
    state = empty_state(config, release)
    return published.import_weights(state, config, out, vggt, release, *args, **kwargs)


def published_tensors(seed=0, **changes):
    """``(vggt, network)``: random tensors of a tiny model under their published names."""
    generator = torch.Generator().manual_seed(seed)
    vggt, network = {}, {}
    for name, tensor in GHGS.from_config(config(**changes)).state_dict().items():
        value = torch.randn(tensor.shape, generator=generator) * 0.1
        if name.startswith("encoder."):
            vggt[published.to_published(name, published.VGGT)] = value
        else:
            network[published.to_published(name, published.RELEASE)] = value
    for name in [name for name in network if name.startswith("pos_head.")]:
        depth = torch.randn(network[name].shape, generator=generator)
        vggt[name.replace("pos_head.", "depth_head.")] = depth
    vggt |= {name: torch.randn(shape, generator=generator) for name, shape in OTHER_HEADS.items()}
    return vggt, network


def write_published(folder, suffix=".safetensors"):
    """Write a tiny VGGT and a tiny release to ``folder``; return their paths and tensors."""
    vggt, network = published_tensors()
    paths = folder / f"vggt{suffix}", folder / "release.pth"
    save_file(vggt, paths[0]) if suffix == ".safetensors" else torch.save(vggt, paths[0])
    torch.save({"network": network, "total_steps": 7, "optimizer": {"state": {}}}, paths[1])
    return paths, (vggt, network)
