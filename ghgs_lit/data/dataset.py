"""Options of data sets: location, reading and batching."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ghgs_lit.config import options
from ghgs_lit.config.options import Count, Options
from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.data.options import LoadingOptions
from ghgs_lit.data.sampling import TargetProtocol, ViewProtocol

if TYPE_CHECKING:  # it imports Lightning, which takes seconds
    from ghgs_lit.data.datamodule import PhotographsDataModule


class Limit(Options):
    """Numbers of subjects."""

    train: Count | None = None
    """Subjects of training that are used, the first ones; null: all."""
    val: Count | None = None
    """Subjects of validation that are used, the first ones; null: all."""

    def of(self, phase: str) -> int | None:
        """Number of subjects of a phase; None: all."""
        return getattr(self, phase, None)


class DataOptions(LoadingOptions):
    """Options of data sets, which build their data module."""

    def build(
        self,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        seed: int = 0,
        augmentation: Augmentation | Mapping[str, Any] | None = None,
    ) -> "PhotographsDataModule":
        """The data module of these options.

        Args:
            views: choice of the inputs.
            targets: choice of the targets.
            seed: of all that is drawn.
            augmentation: variation of training batches; None: none.
        """
        from ghgs_lit.data.datamodule import PhotographsDataModule

        return PhotographsDataModule(self, views, targets, seed, augmentation)


class DataSet(DataOptions):
    """Options of a data set in the user's folder."""

    root: options.PathText | None = None
    """Folder of the data."""
    limit: Limit = Limit()
    """Subjects used of each phase."""
