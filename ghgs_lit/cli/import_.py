"""``ghgs import``: convert published weights to a checkpoint of this package."""

from collections.abc import Mapping
from typing import Any

import lightning.pytorch as L
from omegaconf import DictConfig
from torch import Tensor

from ghgs_lit.cli.inputs import MODEL_NODES
from ghgs_lit.cli.runtime import announce, files_to_write, output_dir, save_config
from ghgs_lit.errors import require
from ghgs_lit.model import GHGS, STAGES
from ghgs_lit.weights.importing import import_weights
from ghgs_lit.weights.switches import differences


def initial_state(config: Mapping[str, Any], release: str | None) -> dict[str, Tensor]:
    """Tensors of a new model. Stages that published weights will fill are on the meta device: the encoder,
    and with the authors' ``release`` all others."""
    filled = STAGES if release is not None else ("encoder",)
    return GHGS.from_config(config, empty=filled).state_dict()


def run(cfg: DictConfig) -> None:
    """Run the verb."""
    config = save_config(cfg, output_dir())
    # New heads in the release's parameterization place half of the points behind the camera.
    safe = config["release"] is not None or config["compat"]["name"] != "release"
    require(safe, "compat", "none where there is no release=<file>", config["compat"]["name"])
    L.seed_everything(config["seed"], workers=True, verbose=False)
    model = {key: config[key] for key in MODEL_NODES if key in config}
    sources = (config["vggt"], config["release"])
    out = files_to_write(config, ["out"], [path for path in sources if path is not None])["out"]
    report = import_weights(initial_state(model, config["release"]), model, out, *sources, config["dtype"])
    print("\n".join(report), flush=True)
    if config["release"] is not None and (differing := differences(config)):
        print(f"differs from the release: {', '.join(differing)}", flush=True)
    announce(out)
