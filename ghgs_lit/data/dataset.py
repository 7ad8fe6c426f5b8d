"""Options of data sets: location, image sizes, batches and caches."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from ghgs_lit.config.options import Count, Index, Options, PathText, Size, Text, Workers
from ghgs_lit.data.reader import PHASES, Reader
from ghgs_lit.data.sampling import TargetProtocol, ViewProtocol
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import require_folder

if TYPE_CHECKING:  # the module imports Lightning, which takes seconds
    from ghgs_lit.data.augmentation import Augmentation
    from ghgs_lit.data.datamodule import PhotographsDataModule


def required_folder(key: str, expected: str, value: str | None) -> Path:
    """Path configured by a key; it need not exist.

    Args:
        key: key of the configuration, for the message.
        expected: description of the folder, for the message.

    Raises:
        InputError: the value is null.
    """
    if value is None:
        raise InputError(f"{key}: expected {expected}; found null")
    return Path(value).expanduser()


class DataOptions(Options):
    """Base class for options of data sets, which builds the data module.

    Attributes:
        static_cameras: whether the data has no views between the cameras (all view numbers are 0).
        ring: number of positions of a full ring of cameras, on which inputs are evenly spaced.
    """

    group = "data"
    static_cameras: ClassVar[bool] = False
    ring: ClassVar[int] = 16

    name: Text
    """Name of the data set in results and messages."""
    size: Size
    """Side or [height, width] of the inputs in pixels."""
    target_size: Size | None = None
    """Side or [height, width] of the targets in pixels; null: same as size."""
    resampling: Literal["area", "release"] = "area"
    """Method of resizing. area: means over exact areas, which shifts nothing. release: as in the authors'
    code (Pillow's bicubic filter for images, OpenCV's nearest neighbour for masks)."""
    batch_size: int = Field(1, ge=1, le=1024)
    """Samples of a step in each process, all in memory at once; at most 1024."""
    steps_per_epoch: Count | None = None
    """Training steps of an epoch; null: whole passes over the subjects, at least 100 steps."""
    packed: bool = True
    """Whether decoded training images are stored in the data's folder or the user's cache, and
    memory-mapped from there; a tenth of the disk stays free."""
    evaluation_positions: tuple[tuple[Index, ...], ...] = ()
    """Lists of input positions for evaluation, such as [[0, 6, 11]] for 3 views; other numbers of views
    are evenly spaced."""
    workers: Workers | Literal["auto"] = "auto"
    """Loading processes per training process; 0: none; auto: chosen from the numbers of cores, devices
    and batches."""

    def build(
        self,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        seed: int = 0,
        augmentation: "Augmentation | Mapping[str, Any] | None" = None,
    ) -> "PhotographsDataModule":
        """Build the data module; arguments as for
        :class:`~ghgs_lit.data.datamodule.PhotographsDataModule`."""
        from ghgs_lit.data.datamodule import PhotographsDataModule

        return PhotographsDataModule(self, views, targets, seed, augmentation)

    @abstractmethod
    def reader(self, phase: str) -> Reader:
        """Create the reader of a split.

        Raises:
            InputError: the data set has missing or bad files.
        """

    def has(self, phase: str) -> bool:
        """Whether a phase has subjects; data without ``train`` can still be evaluated."""
        return True

    @property
    def split_names(self) -> tuple[str, ...]:
        """Names of the splits: ``train``, ``val``, and further ones for evaluation."""
        return PHASES

    def prepare(self, splits: Sequence[str] = PHASES) -> None:
        """Create missing data of splits; called once, before any process reads."""
        return

    def make(self) -> None:
        """Create all data that can be created (``ghgs prepare task=render``)."""
        self.prepare()

    def check_targets(self, targets: TargetProtocol) -> None:
        """Reject a target protocol.

        Raises:
            InputError: it requires views that the data set cannot have.
        """
        return

    @property
    def folder(self) -> Path:
        """Folder of the data, the ``root`` of a subclass.

        Raises:
            InputError: ``data.root`` is null or not a folder.
        """
        folder = required_folder("data.root", "the folder of the data set", self.root)
        require_folder(folder)
        return folder

    @property
    def facts(self) -> dict[str, str]:
        """Provenance of the data for results."""
        return {"name": self.name}

    def split_facts(self, split: str) -> dict[str, str]:
        """Provenance of a split for results."""
        return {"split": split}


class DataSet(DataOptions):
    """Options of a data set that the user has downloaded."""

    root: PathText | None = None
    """Folder of the data."""
