"""Hydra finds sweepers in ``hydra_plugins`` only; what this one does stands in ``ghgs_lit.runs.grid``."""

from typing import Any

from hydra._internal.core_plugins import basic_sweeper


class GridSweeper(basic_sweeper.BasicSweeper):
    """Every combination of values once, without what is done; comes back to what others worked on."""

    def sweep(self, arguments: list[str]) -> Any:
        from ghgs_lit.runs.grid import sweep  # Hydra imports its plugins for every application

        return sweep(self, arguments)
