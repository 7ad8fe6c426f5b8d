"""Watchers of a model's stages: observe their start and end, and their results.

The model contains no code for this: modules get forward hooks, other stages are wrapped while they are
watched.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

from torch import nn


class Watcher:
    """Base class with callbacks at the start and end of stages, including nested ones."""

    def begin(self, stage: str) -> None:
        """Called with the name of a stage when it begins."""

    def end(self, stage: str, result: Any = None) -> None:
        """Called with the name and the result of a stage when it ends."""


@contextmanager
def watch_stages(model: nn.Module, stages: Mapping[str, str], watcher: Watcher) -> Iterator[None]:
    """Call a watcher at every call of the stages while the context is active.

    Args:
        model: Model that contains the stages.
        stages: Dotted paths in ``model`` by the names passed to the watcher; stages that are None or
            missing are skipped.
        watcher: Watcher to call.
    """
    with ExitStack() as stack:
        for name, path in stages.items():
            parent, _, attribute = path.rpartition(".")
            owner = model.get_submodule(parent)
            stage = getattr(owner, attribute, None)
            if isinstance(stage, nn.Module):
                begin = stage.register_forward_pre_hook(lambda *_, name=name: watcher.begin(name))
                end = stage.register_forward_hook(lambda *given, name=name: watcher.end(name, given[-1]))
                stack.callback(begin.remove)
                stack.callback(end.remove)
            elif stage is not None:
                setattr(owner, attribute, Wrapped(stage, name, watcher))
                stack.callback(setattr, owner, attribute, stage)
        yield


@contextmanager
def watch_block(stage: str, watcher: Watcher) -> Iterator[None]:
    """Report the body of the context to ``watcher`` as a stage."""
    watcher.begin(stage)
    yield
    watcher.end(stage)


class Wrapped:
    """A watched stage that is not a module."""

    def __init__(self, stage: Any, name: str, watcher: Watcher):
        self._stage = stage
        self._name = name
        self._watcher = watcher

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        self._watcher.begin(self._name)
        result = self._stage(*arguments, **options)
        self._watcher.end(self._name, result)
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)
