"""Data sets as they are configured: where they lie, how they are read and how photographs become batches."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from ghgs_lit.config import options
from ghgs_lit.config.options import Amount, Count, Index, Options, Size, Text, Workers
from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.data.reader import PHASES, Reader
from ghgs_lit.data.sampling import TargetProtocol, ViewProtocol
from ghgs_lit.errors import InputError
from ghgs_lit.readers import require_data_folder

if TYPE_CHECKING:  # it imports Lightning, which takes seconds
    from ghgs_lit.data.datamodule import PhotographsDataModule


class Limit(Options):
    """Numbers of subjects."""

    train: Count | None = None
    """Subjects of training that are used, the first ones; null: all."""
    val: Count | None = None
    """Subjects of validation that are used, the first ones; null: all."""

    def of(self, phase: str) -> int | None:
        """The number of a phase; None: all."""
        return getattr(self, phase, None)


class DataOptions(Options):
    """Everything that data sets have in common; each has a subclass with the keys of its own. ``published``:
    number of people of each phase in the publication, where there is one. ``static_cameras``: whether there
    are no views between the cameras (their view number is always 0). ``ring``: number of positions on a full
    ring of cameras; inputs are evenly spaced among them."""

    group = "data"
    published: ClassVar[Mapping[str, int]] = {}
    static_cameras: ClassVar[bool] = False
    ring: ClassVar[int] = 16

    name: Text
    """Name of the data set in results and messages."""
    size: Size
    """Side or [height, width] of the inputs in pixels."""
    target_size: Size | None = None
    """Side or [height, width] of the targets in pixels; null: as size."""
    resampling: Literal["area", "release"] = "area"
    """area: means over exact areas, everything stays at its place. release: as the authors' code reads
    (photographs by Pillow's bicubic filter, masks by OpenCV's nearest neighbour)."""
    batch_size: int = Field(1, ge=1, le=1024)
    """Samples of one step in each process, all in memory at once: at most 1024."""
    steps_per_epoch: Count | None = None
    """Training steps of an epoch; null: one pass over the subjects."""
    cache_images_mb: Amount = 512
    """MiB of decoded photographs kept in memory by each process."""
    evaluation_positions: tuple[tuple[Index, ...], ...] = ()
    """Lists of input positions, such as [[0, 6, 11]] for 3 views; other numbers of views: evenly spaced."""
    workers: Workers = 0
    """Loading processes; 0: none."""

    def build(
        self,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        seed: int = 0,
        augmentation: Augmentation | Mapping[str, Any] | None = None,
    ) -> "PhotographsDataModule":
        """Batches of the data set; arguments as for :class:`PhotographsDataModule`."""
        from ghgs_lit.data.datamodule import PhotographsDataModule

        return PhotographsDataModule(self, views, targets, seed, augmentation)

    @abstractmethod
    def reader(self, phase: str, strict: bool = True) -> Reader:
        """The photographs of ``train`` or ``val``; ``strict`` as for :class:`Reader`."""

    def has(self, phase: str) -> bool:
        """Whether there are subjects of a phase; data without ``train`` can be evaluated."""
        return True

    @property
    def split_names(self) -> tuple[str, ...]:
        """Names of the splits that can be read: ``train``, ``val``, and further ones for evaluation."""
        return PHASES

    def prepare(self, splits: Sequence[str] = PHASES) -> None:
        """Make what these splits need and is missing; called once, before any process reads."""
        return

    def inspections(self) -> Sequence[Callable[[], None]]:
        """What ``task=check`` checks beside the photographs; each call raises InputError if it is bad.

        They run in other processes: functions of a module, or partials of them.
        """
        return []

    def check_targets(self, targets: TargetProtocol) -> None:
        """Refuse a configured target protocol whose views this data set never has."""
        return

    @property
    def folder(self) -> Path:
        """The folder of the data, which a subclass names as ``root``. InputError: ``data.root`` is null or no
        folder."""
        folder = required_folder("data.root", "the folder of the data set", self.root)
        require_data_folder(folder)
        return folder

    @property
    def facts(self) -> dict[str, str]:
        """What readers of results must know about how the files are read."""
        return {"name": self.name}

    def split_facts(self, split: str) -> dict[str, str]:
        """What they must know about a split."""
        return {"split": split}


class DataSet(DataOptions):
    """A data set in a folder of the user's."""

    root: options.Path | None = None
    """Folder of the data."""
    limit: Limit = Limit()
    """Subjects used of each phase."""


def required_folder(key: str, expected: str, value: str | None) -> Path:
    """The path configured at ``key``, which need not exist. InputError: it is null."""
    if value is None:
        raise InputError(f"{key}: expected {expected}; found null")
    return Path(value).expanduser()
