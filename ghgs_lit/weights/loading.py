"""Weights of a checkpoint into a model that its configuration has built."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ghgs_lit.kernels.precision import fast_precision
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint, require_finite, require_fit
from ghgs_lit.weights.reading import cast


def load_weights(
    model: nn.Module, path: str | Path, dtype: torch.dtype | None = None, device: Any = "cpu"
) -> None:
    """Give a model the weights of a checkpoint, mapped from the file, not copied.

    Args:
        model: a :class:`ghgs_lit.model.GHGS`; its own weights may be on the meta device.
        dtype: of the encoder (None: as in the file, on a CPU float32 in place of a half precision that it
            lacks); the heads are float32 or wider.
        device: where the weights will be moved to.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is not a checkpoint of this package, or its weights are not finite or do not fit
            the model.
    """
    checkpoint = read_checkpoint(path, whole=True)
    require_fit(model, model_state(checkpoint), path)
    check_preset(model, checkpoint, path)

    def precision(name: str, stored: torch.dtype) -> torch.dtype:
        if name.startswith("encoder."):
            return dtype or fast_precision(stored, torch.device(device))
        return torch.promote_types(stored, torch.float32)

    state = cast(lambda: model_state(read_checkpoint(path)), precision)
    require_finite(state, path)
    model.load_state_dict(state, assign=True)


def check_preset(model: nn.Module, checkpoint: Mapping[str, Any], path: str | Path) -> None:
    """Compare the tokens that take part in a model with those that a checkpoint's training has shown.

    ``skip=auto`` leaves out presets that it did not show. The authors' training showed all tokens: fewer give
    a warning.
    """
    is_release = "release" in (checkpoint.get("imported") or {})
    if model.auto is not None:
        model.auto = model.auto.trained_by({} if is_release else checkpoint["config"])
    elif is_release and model.skip.tokens != "all":
        expected = "all, as in the training of the authors' weights"
        found = f"{model.skip.tokens}, whose error is not known for them"
        warnings.warn(f"{path}: skip.tokens: expected {expected}; found {found}", stacklevel=3)
