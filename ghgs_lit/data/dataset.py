"""Options of data sets: location, reading, batches, and what is kept where."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from ghgs_lit.config.options import Amount, Count, Index, Options, PathText, Size, Text, Workers
from ghgs_lit.data.reader import PHASES, Reader
from ghgs_lit.data.sampling import TargetProtocol, ViewProtocol
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import require_folder

if TYPE_CHECKING:  # the module imports Lightning, which takes seconds
    from ghgs_lit.data.augmentation import Augmentation
    from ghgs_lit.data.datamodule import PhotographsDataModule


def required_folder(key: str, expected: str, value: str | None) -> Path:
    """Path configured at a key, which need not exist.

    Args:
        key: of the configuration, for the message.
        expected: what the folder is, for the message.
        value: of the key.

    Raises:
        InputError: it is null.
    """
    if value is None:
        raise InputError(f"{key}: expected {expected}; found null")
    return Path(value).expanduser()


class Limit(Options):
    """Numbers of subjects."""

    train: Count | None = None
    """Subjects of training that are used, the first ones; null: all."""
    val: Count | None = None
    """Subjects of validation that are used, the first ones; null: all."""

    def of(self, phase: str) -> int | None:
        """Number of subjects of a phase; None: all."""
        return getattr(self, phase, None)


class DataOptions(Options):
    """Base options of data sets, which build their data module.

    Attributes:
        published: number of people of each phase in the publication, if any.
        static_cameras: whether there are no views between the cameras (view numbers are 0).
        ring: number of positions on a full ring of cameras, among which inputs are evenly spaced.
    """

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
    """area: means over exact areas, everything stays at its place. release: as the authors' code
    reads (photographs by Pillow's bicubic filter, masks by OpenCV's nearest neighbour)."""
    batch_size: int = Field(1, ge=1, le=1024)
    """Samples of one step in each process, all in memory at once: at most 1024."""
    class_steps: Count = 1
    """Training batches in a row with equal sizes of photographs and targets, number of views,
    entry of token_budgets and number of rounds: the CUDA graph that is captured in the first two of
    them is replayed in the others."""
    steps_per_epoch: Count | None = None
    """Training steps of an epoch; null: whole passes over the subjects, 100 steps or more."""
    cache_images_mb: Amount = 512
    """MiB of decoded photographs kept in memory by each process."""
    packed_gb: Amount = 16
    """Largest size in GB (10^9 bytes) of the decoded photographs of training that are kept on the
    disk, in the data's folder or the user's cache, and mapped into memory; 0: none are."""
    evaluation_positions: tuple[tuple[Index, ...], ...] = ()
    """Lists of input positions, such as [[0, 6, 11]] for 3 views;
    other numbers of views: evenly spaced."""
    workers: Workers | Literal["auto"] = "auto"
    """Loading processes of each process that trains; 0: none;
    auto: by cores, devices and batches."""

    def build(
        self,
        views: ViewProtocol | Mapping[str, Any],
        targets: TargetProtocol | Mapping[str, Any],
        seed: int = 0,
        augmentation: "Augmentation | Mapping[str, Any] | None" = None,
    ) -> "PhotographsDataModule":
        """The data module of these options.

        Args:
            views: choice of the inputs.
            targets: choice of the targets.
            seed: of all random numbers.
            augmentation: variation of training batches; None: none.
        """
        from ghgs_lit.data.datamodule import PhotographsDataModule

        return PhotographsDataModule(self, views, targets, seed, augmentation)

    @abstractmethod
    def reader(self, phase: str, strict: bool = True) -> Reader:
        """Reader of a split.

        Args:
            phase: name of the split.
            strict: raise the first problem of the data, or collect all, as for :class:`Reader`.
        """

    def has(self, phase: str) -> bool:
        """Whether a phase has subjects; data without ``train`` can be evaluated."""
        return True

    @property
    def split_names(self) -> tuple[str, ...]:
        """Names of the splits: ``train``, ``val``, and further ones for evaluation."""
        return PHASES

    def prepare(self, splits: Sequence[str] = PHASES) -> None:
        """Make missing data; called once, before any process reads.

        Args:
            splits: names of the splits whose data is made.
        """
        return

    def make(self) -> None:
        """Make all data that can be made (``ghgs prepare task=render``)."""
        self.prepare()

    def check_targets(self, targets: TargetProtocol) -> None:
        """Reject a target protocol whose views this data set never has.

        Args:
            targets: the protocol.

        Raises:
            InputError: it requires such views.
        """
        return

    @property
    def folder(self) -> Path:
        """Folder of the data, ``root`` of a subclass.

        Raises:
            InputError: ``data.root`` is null or not a folder.
        """
        folder = required_folder("data.root", "the folder of the data set", self.root)
        require_folder(folder)
        return folder

    @property
    def facts(self) -> dict[str, str]:
        """Provenance of the files for results."""
        return {"name": self.name}

    def split_facts(self, split: str) -> dict[str, str]:
        """Provenance of a split for results."""
        return {"split": split}


class DataSet(DataOptions):
    """Options of a data set in the user's folder."""

    root: PathText | None = None
    """Folder of the data."""
    limit: Limit = Limit()
    """Subjects used of each phase."""
