"""Making data: people, rigs of cameras, photographs, miniatures of data sets."""

import importlib
from typing import Any

# Looked up when asked for: rendering processes import this package too, and need no Lightning.
_MODULES = {
    "RenderedDataModule": "datamodules",
    "ScansDataModule": "datamodules",
    "SyntheticDataModule": "datamodules",
    "THuman2DataModule": "thuman2",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"ghgs_lit.synthesis.{_MODULES[name]}"), name)
