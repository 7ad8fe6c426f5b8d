"""``ghgs import``: published weights to a checkpoint of this package."""

import lightning.pytorch as L
from omegaconf import DictConfig

from ghgs_lit.cli.runtime import announce, output_dir, save_config
from ghgs_lit.errors import require
from ghgs_lit.model import STAGES
from ghgs_lit.weights.importing import import_weights
from ghgs_lit.weights.switches import differences

#: What a checkpoint says about its model; the rest is about this run.
MODEL_NODES = (*STAGES, "skip", "model", "compat", "ablation")


def run(cfg: DictConfig) -> None:
    config = save_config(cfg, output_dir())
    # Fresh heads in the release's parameterisation look behind the camera as often as not.
    safe = config["release"] is not None or config["compat"]["name"] != "release"
    require(safe, "compat", "none where there is no release=<file>", config["compat"]["name"])
    L.seed_everything(config["seed"], workers=True, verbose=False)
    report = import_weights(
        {key: config[key] for key in MODEL_NODES},
        config["out"],
        config["vggt"],
        config["release"],
        config["dtype"],
        config["depth_head_start"],
    )
    print("\n".join(report), flush=True)
    if config["release"] is not None and differences(config):
        print(f"not as the release computes: {', '.join(differences(config))}", flush=True)
    announce(config["out"])
