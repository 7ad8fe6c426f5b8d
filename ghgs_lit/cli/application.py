"""Run a verb as a Hydra application of ``conf/<verb>.yaml``."""

import os
import re
import signal
import sys
import threading
import time
from argparse import Namespace
from dataclasses import dataclass, field
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.cli import messages
from ghgs_lit.config import VERSION_BASE, compose, conf_dir
from ghgs_lit.config.compose import check_ablation, store_defaults, to_plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.options import UnknownKey
from ghgs_lit.config.reading import read_as_ghgs
from ghgs_lit.config.registry import read_nodes, verb_class
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import require_no_links, write_text_atomically
from ghgs_lit.runs.job import register_resolvers
from ghgs_lit.runs.processes import interruptible
from ghgs_lit.runs.run import SESSIONS, WRITTEN, RunDirectory
from ghgs_lit.runtime.allocation import collect_garbage_again
from ghgs_lit.runtime.cores import let_children_sleep

register_resolvers()  # on import, so that the processes of a launcher have them too
read_as_ghgs()


def discard_unused(directory: Path, verb: str, since: float) -> None:
    """Remove a run's directory that contains nothing but files written at startup.

    Args:
        directory: Directory of the run.
        verb: Name of the verb, which is also the name of its log.
        since: Time of startup in seconds since the epoch; older files are kept.
    """
    RunDirectory(directory).discard({".hydra", f"{verb}.log"}, since)


#: Names that a run appends to or that libraries write in place, in addition to the log.
_WRITTEN_IN_PLACE = (".hydra", *WRITTEN, SESSIONS)


def write_hydra_files(cfg: DictConfig, directory: Path) -> None:
    """Write ``.hydra`` as Hydra does, but atomically and never through a link.

    Args:
        cfg: Configuration composed by Hydra.
        directory: Directory of the run.

    Raises:
        InputError: A file that will be written in place is a link.
    """
    require_no_links(directory, (*_WRITTEN_IN_PLACE, f"{HydraConfig.get().job.name}.log"))
    hydra_config = HydraConfig.instance().cfg
    contents = {"config": cfg, "hydra": hydra_config, "overrides": hydra_config.hydra.overrides.task}
    for name, content in contents.items():
        write_text_atomically(directory / ".hydra" / f"{name}.yaml", OmegaConf.to_yaml(content))


@dataclass(frozen=True)
class Verb:
    """Task function of a verb, which Hydra calls in this process or in those of a launcher.

    Attributes:
        name: Name of the verb.
        argv: Command-line arguments, program and verb first.
        wants_trace: Whether errors keep their traceback.
        started: Time of startup in seconds since the epoch.
    """

    name: str
    argv: tuple[str, ...]
    wants_trace: bool = False
    started: float = field(default_factory=time.time)

    @interruptible()
    def __call__(self, cfg: DictConfig) -> object:
        """Check the configuration and do the work of the verb.

        Args:
            cfg: Configuration composed by Hydra.

        Returns:
            Return value of the verb.

        Raises:
            SystemExit: Bad input, outside a sweep; the message is printed.
        """
        # Lightning starts the other processes of a DDP job with sys.argv, which must contain the verb.
        sys.argv = list(self.argv)
        try:
            directory = Path(HydraConfig.get().runtime.output_dir)
            if HydraConfig.get().mode == RunMode.RUN:  # a file may set hydra.mode
                messages.check_directory(HydraConfig.get().overrides.hydra, sweeps=False)
            check_ablation(cfg, HydraConfig.get())
            is_given = any(word.lstrip("+").startswith("overwrite=") for word in self.argv)
            fits = is_given or not cfg.get("overwrite")
            require(fits, "overwrite", "a value on the command line alone", "true in a file")
            verb = verb_class(self.name).begin(to_plain(cfg))
            is_dry = getattr(verb, "dry_run", False)
            if verb.begins_run and not is_dry:
                run = RunDirectory(directory)
                if run.marker is not None:  # start() compares whole configurations
                    verb.complete(to_plain(fill(cfg)))
                run.start(verb)
            if not is_dry:
                write_hydra_files(cfg, directory)
            verb.require_files()
            verb.complete(to_plain(fill(cfg)))  # before slow imports of the verb
            collect_garbage_again()
            let_children_sleep()
            result = verb.run()
            if is_dry:
                discard_unused(directory, self.name, self.started)
            return result
        except messages.BAD_INPUT as error:
            # In a sweep Hydra prints the error with its job's number.
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            discard_unused(Path(HydraConfig.get().runtime.output_dir), self.name, self.started)
            if self.wants_trace:
                raise
            print(f"ghgs {self.name}: {messages.format_error(error, self.name)}", file=sys.stderr)
            raise SystemExit(1) from error


def _rewrite_overrides(verb: str, arguments: list[str]) -> list[str]:
    """Rewrite overrides for Hydra.

    Keys of ``data`` and ``rounds`` are forced (``++``) where these nodes come from a checkpoint, and
    ``sweep=<file>`` sets the mode, which Hydra 1.4 reads before it composes.
    """
    sweeps = any(re.match("sweep=(?!null)", argument) for argument in arguments)
    if sweeps and not any(argument.startswith("hydra.mode=") for argument in arguments):
        return [*arguments, "hydra.mode=MULTIRUN"]
    if not verb_class(verb).has_trained_data:
        return arguments
    has_data = any(argument.startswith("data=") for argument in arguments)
    forced = r"^(?=rounds\.)" if has_data else r"^(?=(data|rounds)\.)"
    return [re.sub(forced, "++", argument) for argument in arguments]


def _print_help(verb: str, words: list[str], folder: str | None) -> int:
    """Print the help of the verb, or of the groups given as words without ``=``, and return the exit
    code."""
    from ghgs_lit.cli.help import print_group, print_verb

    groups = [word for word in words if "=" not in word]
    overrides = _rewrite_overrides(verb, [word for word in words if "=" in word])
    cfg = compose(verb, overrides, with_hydra=True, folder=folder, is_filled=bool(groups))
    for group in groups:
        print_group(verb, group, cfg, folder)
    if not groups:
        print_verb(verb, cfg, folder)
    return 0


def _print_configuration(name: str, overrides: list[str], values: Namespace) -> None:
    """Print the output of Hydra's ``--cfg job``, including the defaults of options.

    ``name`` is the verb or the value of ``--config-name``; ``values`` holds the flags ``--config-dir``,
    ``--package`` and ``--resolve``.
    """
    cfg = compose(name, overrides, with_hydra=True, folder=values.config_dir)
    HydraConfig.instance().set_config(cfg)
    cfg = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    try:
        read_nodes(OmegaConf.to_container(cfg, resolve=True))
    except UnknownKey:
        raise
    except InputError:  # users may print the configuration to find a wrong value
        pass
    if values.resolve:
        OmegaConf.resolve(cfg)
    if values.package not in (None, "_global_"):
        require(OmegaConf.select(cfg, values.package) is not None, "--package", "a key", values.package)
        cfg = OmegaConf.select(cfg, values.package)
        print(f"# @package {values.package}")
    print(OmegaConf.to_yaml(cfg) if OmegaConf.is_config(cfg) else cfg, end="")


def run(verb: str, argv: list[str]) -> int:
    """Run a verb as a Hydra application; errors and interruptions are printed on one line.

    Args:
        verb: Name of a verb.
        argv: Command-line arguments, program and verb first.

    Returns:
        Exit code: 0: success; 1: bad input; 2: bad usage; 128 + signal number: interrupted, such as 130
            by Ctrl-C, or the reader of the output has closed the pipe.
    """
    # With this variable Hydra raises errors, which are handled below, instead of printing them.
    wants_trace = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"
    task = Verb(verb, tuple(argv), wants_trace)
    threading.excepthook = messages.print_thread_error
    try:
        with interruptible():  # around the handling of errors: an interruption may look like one
            flags, overrides, values = messages.parse_arguments(argv[2:])
            if values.help:
                return _print_help(verb, overrides, values.config_dir)
            messages.check_deletions(overrides)
            store_defaults(verb, values.config_dir)
            if values.cfg == "job":
                _print_configuration(values.config_name or verb, _rewrite_overrides(verb, overrides), values)
                return 0
            overrides = _rewrite_overrides(verb, overrides)
            if values.multirun or "hydra.mode=MULTIRUN" in overrides:
                messages.check_directory(overrides, sweeps=True)
            sys.argv = [argv[0], *flags, messages.NO_FILES_OF_HYDRA, *overrides]
            hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name=verb)(task)()
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has closed the pipe; Python must not flush the rest at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except messages.BadUsage as error:
        print(f"ghgs {verb}: {error}", file=sys.stderr)
        return 2
    except Exception as error:
        if wants_trace or not (isinstance(error, messages.BAD_INPUT) or messages.is_raised_by_hydra(error)):
            raise
        print(f"ghgs {verb}: {messages.format_error(error, verb)}", file=sys.stderr)
        return 1
    return 0
