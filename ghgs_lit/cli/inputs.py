"""Build data, renderer, model of a checkpoint and device from a verb's configuration."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from ghgs_lit.cli.verb import Measured
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.keys import ablation_of, flatten, is_below, lookup
from ghgs_lit.config.registry import read_node
from ghgs_lit.config.run import Run
from ghgs_lit.data.sampling import CAMERAS
from ghgs_lit.errors import InputError, require
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.precision import half_precision, keep_rounded
from ghgs_lit.method.model import GHGS, resolve_height
from ghgs_lit.method.stages import OPTIONS, STAGES
from ghgs_lit.rendering import Renderer
from ghgs_lit.rendering.api import resolve_backend
from ghgs_lit.weights.checkpoint import load_weights, read_config
from ghgs_lit.weights.reading import SHIPPED

if TYPE_CHECKING:  # importing Lightning takes seconds
    from ghgs_lit.data.datamodule import PhotographsDataModule

#: Configuration nodes that describe the model.
MODEL_NODES = (*STAGES, *OPTIONS, "compat")

#: Keys of ``data`` that describe the training machine rather than the data.
OF_MACHINE = ("cache_dir", "packed", "render_workers", "workers")

#: Keys that may change in a trained model: they affect neither shape nor meaning of any tensor.
FREE = ("bounds", "encoder.precision", "model.pad", "rounds.count", "rounds.height", "skip", "unprojection")
FREE += ("recalibration.k", "recalibration.neighborhood", "recalibration.similarity", "recalibration.tokens")


def build_data(run: Run) -> "PhotographsDataModule":
    """Build the configured data module with its view and target protocols.

    Raises:
        InputError: Files of the data set are wrong.
    """
    # Any data set has cameras as possible targets; a verb without a target protocol reads no targets.
    targets = run.targets or CAMERAS
    extra = {} if run.augmentation is None else {"augmentation": run.augmentation}
    return run.data.build(views=run.views, targets=targets, seed=run.seed, **extra)


def build_renderer(run: Run, device: torch.device) -> Renderer:
    """Build the configured renderer.

    Args:
        run: Run of a verb with a renderer.
        device: Device on which it will run.

    Raises:
        InputError: The renderer does not run on ``device``.
    """
    renderer = run.renderer.build()
    if (backend := getattr(renderer, "backend", None)) is not None:  # renderers of plug-ins may lack it
        resolve_backend(backend, device)
    return renderer


def load_predictor(
    nodes: Mapping[str, Any], checkpoint: str, device: torch.device, precision: str = "inherit"
) -> Predictor:
    """Load the predictor of a checkpoint in evaluation mode.

    Args:
        nodes: Model nodes by name as plain data, such as those returned by :func:`model_of`.
        checkpoint: Path of the file, or ``shipped``.
        device: Device on which the model will run.
        precision: Precision of its matrix products.

    Raises:
        FileNotFoundError: The checkpoint does not exist.
        InputError: It is not a checkpoint of this package, or its weights do not fit the model.
    """
    model = GHGS.from_config(nodes, empty=True)
    load_weights(model, checkpoint, device=device)
    half = half_precision(precision, device)
    if half is not None and device.type == "cuda":
        keep_rounded(model.encoder, half)  # safe: a verb never changes its precision
    return Predictor(model.to(device).eval(), precision=precision)


def check_size(data: "PhotographsDataModule", predictor: Predictor) -> None:
    """Check the image size before any image is read.

    Args:
        data: Provides the size to which images are cropped.
        predictor: Provides the patch size and the padding.

    Raises:
        InputError: A side is not a multiple of the patch size.
    """
    size = data.dataset.size
    multiple = predictor.side_multiple
    expected = f"sides divisible by the patch size {multiple} (or model.pad=multiple)"
    require(not any(side % multiple for side in size), "data.size", expected, list(size))


def with_trained_data(run: Measured) -> Measured:
    """Fill in the data that the checkpoint was trained on, unless ``data=<option>`` was chosen.

    Keys given on the command line, such as ``data.root=...``, replace those of the checkpoint; keys of
    the training machine (:data:`OF_MACHINE`) have their defaults.

    Returns:
        The run with data.

    Raises:
        InputError: There is no checkpoint, it contains no training data, or the folder of its data does
            not exist.
    """
    if run.data is not None:
        return run
    checkpoint = run.checkpoint
    if checkpoint is None:
        raise InputError("data: expected data=<option> where there is no checkpoint; found none")
    if checkpoint == SHIPPED:  # its training data is generated and would have to be rendered first
        expected = "images=<folder> cameras=<file>, or data=<option>, with the weights of the package"
        raise InputError(f"data: expected {expected}; found neither")
    trained = read_config(checkpoint)
    if not trained.get("data"):
        expected = f"data=<option> for weights that were imported ({checkpoint})"
        raise InputError(f"data: expected {expected}; found none")
    data = {key: value for key, value in trained["data"].items() if key not in OF_MACHINE}
    merged = OmegaConf.merge({"data": data}, {"data": run.plain.get("data") or {}})
    root = merged.data.get("root")
    if "root" in data and root == data["root"] and isinstance(root, str) and not Path(root).is_dir():
        expected = f"data.root=<folder>, as the data of {checkpoint} is not where it was trained"
        raise InputError(f"data.root: expected {expected}; found no such folder {root!r}")
    return run.replace(data=OmegaConf.to_container(fill(merged))["data"])


def model_of(checkpoint: str, run: Run) -> dict[str, Any]:
    """Model nodes of a checkpoint, with changes given on the command line.

    Options that a verb composes by default are ignored because they describe another model.

    Args:
        checkpoint: Path of the file, or ``shipped``.
        run: Run as composed.

    Returns:
        The nodes :data:`MODEL_NODES` and ``chosen``, as far as the checkpoint contains them.

    Raises:
        InputError: The checkpoint does not contain a whole model, or its weights do not allow a change.
    """
    trained = read_config(checkpoint)
    if trained.keys() & set(STAGES) == {"encoder"}:
        hint = f"`ghgs train init_from={checkpoint}` starts from it"
        raise InputError(f"{checkpoint}: expected a whole model; found the encoder alone ({hint})")
    for stage in STAGES:
        place = f"{checkpoint}: config.{stage}"
        node = trained.get(stage)
        require(isinstance(node, Mapping), place, "a stage of the model", node)
    before = {node: trained[node] for node in (*MODEL_NODES, "chosen") if node in trained}
    after = OmegaConf.create(before)
    for key in (given.removesuffix(".kind") for given in given_keys()):  # another kind has other keys
        if key == "ablation":
            wanted = HydraConfig.get().runtime.choices["ablation"]
            expected = f"{ablation_of(trained)}, as the checkpoint was trained"
            expected += " (recalibration.neighborhood=... and .similarity=... act)"
            require(wanted == ablation_of(trained), "ablation", expected, wanted)
        if not is_below(key, MODEL_NODES):
            continue
        if is_below(key, ("rounds",)):  # Hydra composes no node to compare with
            rounds = trained.get("rounds")
            expected = f"no key of rounds, as the model of {checkpoint} has none (model=recurrent has)"
            require(isinstance(rounds, Mapping), key, expected, "one")
            read_node({**rounds, **run.plain["rounds"]}, "rounds")
        value = lookup(run.plain, key)
        if is_below(key, FREE):
            OmegaConf.update(after, key, value, merge=False, force_add=True)
        else:
            _require_same(before, key, value)
    # The height depends on the training of the weights, whose images may have been smaller.
    return resolve_height(OmegaConf.to_container(after, resolve=True), trained)


def _require_same(trained: Mapping[str, Any], key: str, value: Any) -> None:
    """Reject values that differ from those of training; keys of :data:`FREE` may differ."""
    for name, wanted in flatten(value, key).items():
        before = lookup(trained, name)
        same = before == wanted or is_below(name, FREE)
        require(same, name, f"{before!r}, which the checkpoint's weights were trained with", wanted)


def with_chosen_targets(run: Measured) -> Measured:
    """Evaluate only the protocol of ``targets=<option>`` if it is given without ``evaluation.targets``.

    Returns:
        The run, with ``evaluation.targets`` set accordingly.
    """
    keys = given_keys()
    if "targets" not in keys or is_below("evaluation.targets", keys):
        return run
    return run.with_changes(evaluation={"targets": [run.targets.name]})


def pick_device(name: str) -> torch.device:
    """Device of a verb.

    Args:
        name: ``cpu``, ``cuda``, or ``auto``: CUDA if available, otherwise the CPU.

    Raises:
        InputError: CUDA is requested but not available.
    """
    there = torch.cuda.is_available()
    require(there or name != "cuda", "device", "auto or cpu on a machine without CUDA", name)
    return torch.device("cuda" if name != "cpu" and there else "cpu")


def choices() -> dict[str, str]:
    """Chosen option of each config group in this run; empty outside Hydra."""
    return dict(HydraConfig.get().runtime.choices) if HydraConfig.initialized() else {}


def overrides() -> list[str]:
    """Overrides of the command line or the sweep in this run; empty outside Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def given_keys() -> list[str]:
    """Keys and groups of :func:`overrides`, in order."""
    return [part.key_or_group for part in OverridesParser.create().parse_overrides(overrides())]
