"""Photographs of people: read from published data sets, drawn into batches."""

import importlib
from typing import Any

# Looked up when asked for: rendering processes import this package too, and need no Lightning.
_MODULES = {
    "HuMManDataModule": "humman",
    "ZJUMoCapDataModule": "zju_mocap",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"ghgs_lit.data.{_MODULES[name]}"), name)
