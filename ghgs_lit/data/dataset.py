"""A data set as it is configured: where it lies and how it is read."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from ghgs_lit.config.settings import set_fields
from ghgs_lit.data.reader import PHASES, Reader
from ghgs_lit.data.sampling import TargetProtocol
from ghgs_lit.errors import InputError, choice, require


@dataclass(frozen=True, kw_only=True)
class DataSet(ABC):
    """What all data sets have in common. A subclass adds one field for each configuration key of its own.

    Attributes:
        name: name of the data set in results and messages.
        root: folder of the data.
        limit: number of subjects used of each phase, the first ones: ``{train: n, val: n}`` (null: all).
        ring: number of positions on a full ring of cameras.
        published: number of people of each phase in the publication, where there is one.
        static_cameras: whether there are no views between the cameras (their view number is always 0).
    """

    published: ClassVar[Mapping[str, int]] = {}
    static_cameras: ClassVar[bool] = False

    name: str
    root: str | None = None
    limit: Mapping[str, int | None] = field(default_factory=dict)
    ring: int = 16

    def __post_init__(self) -> None:
        require(self.ring >= 2, "data.ring", "at least 2", self.ring)
        for phase, count in (self.limit or {}).items():
            choice("data.limit key", phase, PHASES)
            require(count is None or count >= 1, f"data.limit.{phase}", "at least 1 or null", count)
        set_fields(self, limit=dict.fromkeys(PHASES) | dict(self.limit or {}))

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
    def facts(self) -> dict[str, str]:
        """What readers of results must know about how the files are read."""
        return {"name": self.name}

    def split_facts(self, split: str) -> dict[str, str]:
        """What they must know about a split."""
        return {"split": split}

    @property
    def folder(self) -> Path:
        """The folder ``root``.

        Raises:
            InputError: ``root`` is null or no folder.
        """
        folder = required_folder("data.root", "the folder of the data set", self.root)
        if not folder.is_dir():
            raise InputError(f"{folder}: expected the folder of the data set; found no such folder")
        return folder


def required_folder(key: str, expected: str, value: str | None) -> Path:
    """The path configured at ``key``, which need not exist.

    Raises:
        InputError: it is null.
    """
    if value is None:
        raise InputError(f"{key}: expected {expected}; found null")
    return Path(value).expanduser()
