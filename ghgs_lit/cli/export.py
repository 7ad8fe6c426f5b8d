"""``ghgs export``: a checkpoint to the names of the authors' release and of VGGT-1B."""

from omegaconf import DictConfig

from ghgs_lit.cli.runtime import announce, output_dir, save_config
from ghgs_lit.weights.checkpoint import read_checkpoint
from ghgs_lit.weights.exporting import export_weights
from ghgs_lit.weights.switches import differences


def run(cfg: DictConfig) -> None:
    """The verb; prints the path of the written weights last."""
    config = save_config(cfg, output_dir())
    report = export_weights(config["checkpoint"], config["vggt"], config["release"])
    print("\n".join(report), flush=True)
    differing = differences(read_checkpoint(config["checkpoint"])["config"])
    if config["release"] is not None and differing:
        print(f"differs from the release: {', '.join(differing)}", flush=True)
    announce(config["release"] or config["vggt"])
