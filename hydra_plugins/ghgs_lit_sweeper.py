"""The sweeper's class, which Hydra finds only in ``hydra_plugins``;
``ghgs_lit.runs.sweep`` does the work."""

from typing import Any

from hydra._internal.core_plugins import basic_sweeper
from hydra.core.config_store import ConfigStore


def rehearse(planned: list[Any]) -> Any:
    """Check the prerequisites of runs; an argument, because sweeps do not import verbs."""
    from ghgs_lit.cli import rehearsal  # here: other commands need no PyTorch yet

    return rehearsal.rehearse(planned)


class GridSweeper(basic_sweeper.BasicSweeper):
    """Runs every combination of values once, and skips runs that are done."""

    def __init__(self, params: dict[str, str] | None = None) -> None:
        super().__init__(max_batch_size=None, params=params)

    def sweep(self, arguments: list[str]) -> Any:
        from ghgs_lit.runs.sweep import sweep  # Hydra imports its plugins for every application

        return sweep(self, arguments, rehearse)


# params: comma-separated values by key, as on the command line, which replaces them.
_NODE = {"_target_": f"{__name__}.GridSweeper", "params": None}
ConfigStore.instance().store(group="hydra/sweeper", name="grid", node=_NODE, provider="ghgs_lit")
