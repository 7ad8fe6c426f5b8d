"""A verb of ``ghgs`` is one class: its summary, an example, its keys, and what it does.

The fields of a verb are the keys that ``conf/<verb>.yaml`` sets in addition to its groups, whose options
are its attributes (:class:`ghgs_lit.config.run.Run`). All verbs are registered in
:mod:`ghgs_lit.config.registry`, those of this distribution like those of a plug-in.
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
#: One entry of ``token_budgets``.
Budget = Literal["all", "window"] | Patches
Budgets = Annotated[tuple[Budget, ...], Field(min_length=1)]


class Verb(Run):
    """Base of all verbs; the first line of the docstring is the summary that
    ``ghgs --help`` prints."""

    work: ClassVar[str] = ""
    """Import path of the function that does the work; a verb without one defines :meth:`run`."""
    example: ClassVar[str] = ""
    """A command, for ``ghgs --help``."""
    opens: ClassVar[tuple[str, ...]] = ()
    """Keys whose checkpoints must exist."""
    reads_data: ClassVar[bool] = False
    """Whether it reads a data set without making it, so that the folder must exist."""
    has_trained_data: ClassVar[bool] = False
    """Whether the data comes from the checkpoint where no ``data=<option>`` is chosen."""
    begins_run: ClassVar[bool] = False
    """Whether its directory becomes that of a run at once,
    before a run of others gets files of this one."""

    @classmethod
    def summary(cls) -> str:
        """What the verb does, in one line."""
        return (cls.__doc__ or "").partition("\n")[0].rstrip(".")

    def require_files(self) -> None:
        """Check that the files of the verb exist, before anything is imported that takes seconds.

        Raises:
            FileNotFoundError, InputError: a file or folder is missing or wrong;
                the message is its reader's.
        """
        from ghgs_lit.parsing import require_folder  # here: --help needs no NumPy
        from ghgs_lit.weights.reading import require_weights

        for key in self.opens:
            if getattr(self, key) not in (None, "auto"):
                require_weights(getattr(self, key))
        data = self.plain.get("data")  # which is not checked yet
        is_read = self.reads_data and isinstance(data, Mapping) and not data.get("source")
        if is_read and isinstance(data.get("root"), str):
            require_folder(Path(os.path.expanduser(data["root"])))

    def run(self) -> object:
        """Do the work of the verb.

        Returns:
            A number that a sweeper optimises, if any.
        """
        return import_object(self.work)(self)


class Measured(Verb):
    """Keys of verbs that run a model."""

    device: Device = "auto"
    """auto: CUDA where there is one."""
    precision: Precision = "inherit"
    """Of the model's matrix products; inherit: of its weights and inputs."""
    seed: Seed = 1
    """Of the data's random choices and of random weights."""


class Training(Verb):
    """Keys of verbs that train."""

    seed: Seed = 1
    """Of weights, of samples and of their order."""
    resume: Literal["auto"] | PathText | None = "auto"
    """A checkpoint to go on from; auto: where the run in the directory stands;
    null: begins anew."""
    overwrite: bool = False
    """Delete the run that is in the directory already."""
