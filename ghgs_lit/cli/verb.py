"""Base classes of the verbs of ``ghgs``: a verb's summary, an example, its keys, and its work.

The fields of a verb are the keys that ``conf/<verb>.yaml`` sets in addition to its groups, whose options
are its attributes (:class:`ghgs_lit.config.run.Run`). All verbs are registered in
:mod:`ghgs_lit.config.registry`, those of this distribution in the same way as those of a plug-in.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from ghgs_lit.config.options import Patches, PathText, Seed
from ghgs_lit.config.registry import import_object
from ghgs_lit.config.run import Run

Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["inherit", "float32", "tf32", "bfloat16", "float16", "auto"]
#: Entry of ``token_budgets``.
Budget = Literal["all", "window"] | Patches
Budgets = Annotated[tuple[Budget, ...], Field(min_length=1)]


class Verb(Run):
    """Base of all verbs; the first line of a verb's docstring is its summary in ``ghgs --help``."""

    work: ClassVar[str] = ""
    """Import path of the function that does the work; a verb without one overrides :meth:`run`."""
    example: ClassVar[str] = ""
    """Example command for ``ghgs --help``."""
    opens: ClassVar[tuple[str, ...]] = ()
    """Keys of checkpoints that must exist."""
    reads_data: ClassVar[bool] = False
    """Whether the verb reads a data set without creating it, so that its folder must exist."""
    has_trained_data: ClassVar[bool] = False
    """Whether the data is that of the checkpoint if no ``data=<option>`` is chosen."""
    begins_run: ClassVar[bool] = False
    """Whether the directory becomes a run's and is checked before any file is written, so that another
    run never receives files of this one."""

    @classmethod
    def summary(cls) -> str:
        """One-line description of the verb."""
        return (cls.__doc__ or "").partition("\n")[0].rstrip(".")

    def require_files(self) -> None:
        """Check that the input files of the verb exist, before imports that take seconds.

        Raises:
            FileNotFoundError, InputError: A file or folder is missing or wrong.
        """
        from ghgs_lit.parsing import require_folder  # here: --help does not need NumPy
        from ghgs_lit.weights.reading import require_weights

        for key in self.opens:
            if getattr(self, key) not in (None, "auto"):
                require_weights(getattr(self, key))
        data = self.plain.get("data")  # not validated yet
        is_read = self.reads_data and isinstance(data, Mapping) and not data.get("source")
        if is_read and isinstance(data.get("root"), str):
            require_folder(Path(os.path.expanduser(data["root"])))

    def run(self) -> object:
        """Do the work of the verb.

        Returns:
            A number for a sweeper to optimize, if any.
        """
        return import_object(self.work)(self)


class Measured(Verb):
    """Base of verbs that run a model."""

    device: Device = "auto"
    """Device; auto: CUDA if available, otherwise the CPU."""
    precision: Precision = "inherit"
    """Precision of the model's matrix products; inherit: that of its weights and inputs."""
    seed: Seed = 1
    """Seed of random choices of data and of random weights."""


class Training(Verb):
    """Base of verbs that train."""

    seed: Seed = 1
    """Seed of the weights, the samples and their order."""
    resume: Literal["auto"] | PathText | None = "auto"
    """Checkpoint to resume from; auto: continue the run in the directory, if any; null: start anew."""
    overwrite: bool = False
    """Delete the run that the directory already contains."""
