"""Photographs of people: made from meshes, kept on disk in one layout, drawn into batches."""

from typing import Any

# Looked up when asked for: rendering processes import this package too, and need no Lightning.
_MODULES = {"RenderedDataModule", "ScansDataModule", "SyntheticDataModule"}

__all__ = ["RenderedDataModule", "ScansDataModule", "SyntheticDataModule"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ghgs_lit.data import datamodule

    return getattr(datamodule, name)
