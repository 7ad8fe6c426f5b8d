"""Data, renderer, model of a checkpoint and device, as a verb's configuration describes them."""

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
from ghgs_lit.method.model import GHGS, with_known_height
from ghgs_lit.method.stages import OPTIONS, STAGES
from ghgs_lit.rendering import Renderer
from ghgs_lit.rendering.api import resolve_backend
from ghgs_lit.weights.checkpoint import load_weights, read_config
from ghgs_lit.weights.reading import SHIPPED

if TYPE_CHECKING:  # it would import Lightning, which takes seconds
    from ghgs_lit.data.datamodule import PhotographsDataModule

#: Nodes of the configuration that describe the model.
MODEL_NODES = (*STAGES, *OPTIONS, "compat")

#: Keys of ``data`` that describe the machine that trained, not the data.
OF_MACHINE = ("cache_dir", "cache_images_mb", "packed_gb", "render_workers", "workers")

#: Keys that may change in a trained model: they change neither shape nor meaning of any tensor.
FREE = ("bounds", "encoder.precision", "model.pad", "rounds.count", "rounds.height", "skip", "unprojection")
FREE += ("recalibration.k", "recalibration.neighborhood", "recalibration.similarity", "recalibration.tokens")


def build_data(run: Run) -> "PhotographsDataModule":
    """The configured data with its view and target protocols.

    Args:
        run: of a verb with data.

    Raises:
        InputError: files of the data are wrong.
    """
    # Every data set has cameras that can be targets; a verb without a target protocol reads none.
    targets = run.targets or CAMERAS
    # of verbs that train
    extra = {} if run.augmentation is None else {"augmentation": run.augmentation}
    return run.data.build(views=run.views, targets=targets, seed=run.seed, **extra)


def build_renderer(run: Run, device: torch.device) -> Renderer:
    """The configured renderer.

    Args:
        run: of a verb with a renderer.
        device: where it will run.

    Raises:
        InputError: it does not run on ``device``.
    """
    renderer = run.renderer.build()
    if (backend := getattr(renderer, "backend", None)) is not None:  # a plug-in's may have none
        resolve_backend(backend, device)
    return renderer


def load_predictor(
    nodes: Mapping[str, Any], checkpoint: str, device: torch.device, precision: str = "inherit"
) -> Predictor:
    """The predictor of a checkpoint, in evaluation mode.

    Args:
        nodes: of the model by name as plain data, such as those of :func:`model_of`.
        checkpoint: path of the file, or ``shipped``.
        device: where the model will run.
        precision: of its products.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        InputError: it is none of this package, or its weights do not fit the model.
    """
    model = GHGS.from_config(nodes, empty=True)
    load_weights(model, checkpoint, device=device)
    half = half_precision(precision, device)
    if half is not None and device.type == "cuda":
        keep_rounded(model.encoder, half)  # a verb never changes its precision
    return Predictor(model.to(device).eval(), precision=precision)


def check_size(data: "PhotographsDataModule", predictor: Predictor) -> None:
    """Check the size of photographs before any is read.

    Args:
        data: has the size that its photographs are cropped to.
        predictor: has the size of a patch, and how it pads.

    Raises:
        InputError: a side is no multiple of the patch.
    """
    size = data.dataset.size
    multiple = predictor.side_multiple
    expected = f"sides divisible by the patch size {multiple} (or model.pad=multiple)"
    require(not any(side % multiple for side in size), "data.size", expected, list(size))


def with_trained_data(run: Measured) -> Measured:
    """Fill in the data that the checkpoint was trained on, unless ``data=<option>`` was chosen.

    Given keys such as ``data.root=...`` change it; keys of the machine that trained
    (:data:`OF_MACHINE`) have their defaults.

    Args:
        run: as composed.

    Returns:
        The run with data.

    Raises:
        InputError: there is no checkpoint, it stores no training data, or its folder is not here.
    """
    if run.data is not None:
        return run
    checkpoint = run.checkpoint
    if checkpoint is None:
        raise InputError("data: expected data=<option> where there is no checkpoint; found none")
    if checkpoint == SHIPPED:  # its training data would have to be rendered first
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
    """Model nodes of a checkpoint, with the changes of the command line.

    The options that a verb composes by default do not count: they describe another model.

    Args:
        checkpoint: path of the file, or ``shipped``.
        run: as composed.

    Returns:
        The nodes :data:`MODEL_NODES` and ``chosen``, as far as the checkpoint has them.

    Raises:
        InputError: it is no whole model, or the weights do not allow a change.
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
    if any(is_below(key, ("rounds",)) for key in given_keys()):
        _check_rounds(checkpoint, before.get("rounds"), run.plain["rounds"])
    for key in (given.removesuffix(".kind") for given in given_keys()):  # another kind has other keys
        if key == "ablation":
            _require_ablation(trained)
        if not is_below(key, MODEL_NODES):
            continue
        value = lookup(run.plain, key)
        if is_below(key, FREE):
            OmegaConf.update(after, key, value, merge=False, force_add=True)
        else:
            _require_same(before, key, value)
    # The height follows from the weights' training, whose photographs may have been smaller.
    return with_known_height(OmegaConf.to_container(after, resolve=True), trained)


def _check_rounds(checkpoint: str, trained: Any, given: Mapping[str, Any]) -> None:
    """Refuse keys of rounds that a checkpoint's model does not have: Hydra composes none to compare with.

    Args:
        checkpoint: path of the file, or ``shipped``.
        trained: its node ``rounds``; None where its model has none.
        given: keys of the command line with their values.

    Raises:
        InputError: names the key.
    """
    if not isinstance(trained, Mapping):
        expected = f"no key of rounds, as the model of {checkpoint} has none (model=recurrent has)"
        raise InputError(f"rounds.{next(iter(given))}: expected {expected}; found one")
    read_node({**trained, **given}, "rounds")


def _require_same(trained: Mapping[str, Any], key: str, value: Any) -> None:
    """Refuse values that differ from those the checkpoint was trained with.

    Args:
        trained: nodes of the model as plain data.
        key: dotted key or group of an override.
        value: what the override composes, as plain data; keys of :data:`FREE` below it may differ.

    Raises:
        InputError: names the first key that differs.
    """
    for name, wanted in flatten(value, key).items():
        before = lookup(trained, name)
        same = before == wanted or is_below(name, FREE)
        require(same, name, f"{before!r}, which the checkpoint's weights were trained with", wanted)


def _require_ablation(trained: Mapping[str, Any]) -> None:
    """Refuse another ``ablation`` than the trained one; its switches can be set one by one instead.

    Args:
        trained: configuration of the checkpoint as plain data.

    Raises:
        InputError: another one was chosen.
    """
    before = ablation_of(trained)
    wanted = HydraConfig.get().runtime.choices["ablation"]
    switches = "recalibration.neighborhood=... and .similarity=... act"
    require(wanted == before, "ablation", f"{before}, as the checkpoint was trained ({switches})", wanted)


def with_chosen_targets(run: Measured) -> Measured:
    """Measure only the protocol of ``targets=<option>``, if given without ``evaluation.targets``.

    Args:
        run: as composed.

    Returns:
        The run, with ``evaluation.targets`` where it is so.
    """
    keys = given_keys()
    if "targets" not in keys or is_below("evaluation.targets", keys):
        return run
    return run.changed(evaluation={"targets": [run.targets.name]})


def pick_device(name: str) -> torch.device:
    """The device of a verb.

    Args:
        name: cpu, cuda, or auto: CUDA, else the CPU.

    Raises:
        InputError: there is no CUDA device.
    """
    there = torch.cuda.is_available()
    require(there or name != "cuda", "device", "auto or cpu on a machine without CUDA", name)
    return torch.device("cuda" if name != "cpu" and there else "cpu")


def choices() -> dict[str, str]:
    """Chosen option of each config group in this run; empty outside of Hydra."""
    return dict(HydraConfig.get().runtime.choices) if HydraConfig.initialized() else {}


def overrides() -> list[str]:
    """Overrides of the command line or the sweep in this run; empty outside of Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def given_keys() -> list[str]:
    """Keys and groups of :func:`overrides`, in order."""
    return [part.key_or_group for part in OverridesParser.create().parse_overrides(overrides())]
