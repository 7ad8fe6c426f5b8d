"""Files of published weights in small, with the names of the published ones."""

import gzip
import json
from functools import cache
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from safetensors.torch import save_file

from ghgs_lit.cli.import_ import MODEL_NODES
from ghgs_lit.config import conf_dir
from ghgs_lit.model import GHGS
from ghgs_lit.weights import names

with gzip.open(Path(__file__).parents[1] / "fixtures" / "published_keys.json.gz") as file:
    PUBLISHED = json.load(file)

TINY = ["encoder.width=32", "encoder.heads=2", "encoder.depth=4", "encoder.layers=[0,1,2,3]"]
TINY += ["encoder.vit.depth=2", "encoder.vit.heads=2", "encoder.image_size=56"]

#: What VGGT-1B has beside the aggregator and its depth head, in part.
OTHER_HEADS = {"camera_head.pose.weight": (9, 4), "point_head.norm.bias": (8,), "track_head.x.bias": (2,)}


def config(*overrides, tiny=True):
    return json.loads(_composed((*(TINY if tiny else ()), *overrides)))


@cache
def _composed(overrides):
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        composed = compose("import", overrides=list(overrides))
    return json.dumps({key: OmegaConf.to_container(composed[key], resolve=True) for key in MODEL_NODES})


def published_tensors(seed=0, **changes):
    """``(vggt, network)``: random tensors of a tiny model under their published names."""
    generator = torch.Generator().manual_seed(seed)
    vggt, network = {}, {}
    for name, tensor in GHGS.from_config(config(**changes)).state_dict().items():
        value = torch.randn(tensor.shape, generator=generator) * 0.1
        if name.startswith("encoder."):
            vggt[names.to_published(name, names.VGGT)] = value
        else:
            network[names.to_published(name, names.RELEASE)] = value
    for name in [name for name in network if name.startswith("pos_head.")]:
        depth = torch.randn(network[name].shape, generator=generator)
        vggt[name.replace("pos_head.", "depth_head.")] = depth
    vggt |= {name: torch.randn(shape, generator=generator) for name, shape in OTHER_HEADS.items()}
    return vggt, network


def write_published(folder, suffix=".safetensors"):
    """Paths of a tiny VGGT and of a tiny release in ``folder``, and what they hold."""
    vggt, network = published_tensors()
    paths = folder / f"vggt{suffix}", folder / "release.pth"
    save_file(vggt, paths[0]) if suffix == ".safetensors" else torch.save(vggt, paths[0])
    torch.save({"network": network, "total_steps": 7, "optimizer": {"state": {}}}, paths[1])
    return paths, (vggt, network)
