"""Run a verb as a Hydra application of ``conf/<verb>.yaml``; errors are one line,
``<path or key>: expected ...; found ...``."""

import argparse
import contextlib
import os
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ghgs_lit.cli.help import print_help
from ghgs_lit.config import VERSION_BASE, compose, conf_dir
from ghgs_lit.config.compose import check_ablation, store_defaults, to_plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.keys import is_below
from ghgs_lit.config.options import did_you_mean
from ghgs_lit.config.reading import read_as_ghgs
from ghgs_lit.config.registry import KINDS, read_nodes, verb_class
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import require_no_links
from ghgs_lit.runs.job import register_resolvers
from ghgs_lit.runs.processes import interruptible
from ghgs_lit.runs.run import WRITTEN, RunDirectory
from ghgs_lit.runtime.allocation import collect_garbage_again
from ghgs_lit.runtime.cores import let_children_sleep

register_resolvers()  # on import, so that the processes of a launcher have them too
read_as_ghgs()


#: Errors that indicate bad input rather than a bug.
BAD_INPUT = (InputError, OSError, HydraException, OmegaConfBaseException)

#: Hydra would write .hydra through links; a run's config.yaml replaces it. An override, because Hydra's
#: default takes precedence over ``conf/hydra/output``.
NO_FILES_OF_HYDRA = "hydra.output_subdir=null"

#: Nodes of Lightning's classes; their keys have defaults, so they may be deleted.
_LIGHTNING = ("trainer", "callbacks", "logger")


def is_bad_input(error: Exception) -> bool:
    """Whether an error is one of :data:`BAD_INPUT`, or was raised in the code of Hydra or OmegaConf or by
    the YAML parser."""
    if isinstance(error, (*BAD_INPUT, YAMLError)):
        return True
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return innermost.f_globals.get("__name__", "").split(".")[0] in ("hydra", "omegaconf")


def format_error(error: Exception, verb: str) -> str:
    """Message of an error on one line.

    Args:
        error: Bad input, see :func:`is_bad_input`.
        verb: Name of the verb; its keys are suggested for misspelt ones.
    """
    text = str(error)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        text = _explain_missing_option(error)
    elif isinstance(error, OSError) and error.errno is not None:
        path = error.filename2 or error.filename or "."
        text = f"{path}: expected a file or folder that can be read or written; found {error.strerror}"
    elif isinstance(error, OmegaConfBaseException):
        text = f"{error.full_key}: expected a value that can be resolved; found {error.msg}"
    elif not isinstance(error, InputError | OSError):
        text = _explain_override(error, verb)
    return " ".join(text.split())


def _explain_missing_option(error: MissingConfigException) -> str:
    """Message for an unknown group or option, in place of Hydra's, which lists the whole search path."""
    group, _, option = error.missing_cfg_file.rpartition("/")
    known = sorted(error.options or ())
    expected = f"one of {', '.join(known)}" if known else "a configuration of the search path"
    return f"{group or '--config-name'}: expected {expected}; found {option!r}{did_you_mean(option, known)}"


def _explain_override(error: Exception, verb: str) -> str:
    """Message for an unknown key, with the closest group or key of the verb, for a number in place of an
    option, or for another override that Hydra rejects."""
    message = str(error)
    if unknown := re.match(r"Could not override '([^']+)'", message):
        name, *_ = unknown[1].split(".")
        known = {*verb_class(verb).model_fields, *KINDS}
        known.update(path.name for path in conf_dir().iterdir() if path.is_dir())
        hint = "" if name in known else did_you_mean(name, known)
        return f"{unknown[1]}: expected a key or group of this verb; found none of that name{hint}"
    # Hydra's error contains neither the group nor the number.
    for group, _, option in (word.partition("=") for word in sys.argv[1:]):
        known = sorted(path.stem for path in (conf_dir() / group).glob("*.yaml"))
        if known and re.match(r"\d|null$", option):
            return f"{group}: expected one of {', '.join(known)}; found {option}"
    quoted = re.search(r"'([^'=]+)", message)
    named = quoted[1] if quoted else " ".join(word for word in sys.argv[1:] if word != NO_FILES_OF_HYDRA)
    if isinstance(error, OverrideParseException):
        named = error.override
    expected = "key=value or group=option (special characters in quotes: 'key=\"value\"')"
    return f"{named}: expected {expected}; found {message} {error.__cause__ or ''}"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:
        print(f"ghgs: {message} (--hydra-help lists the flags)", file=sys.stderr)
        raise SystemExit(2)


def parse_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str], argparse.Namespace]:
    """Split the arguments of a verb.

    Args:
        arguments: Command-line arguments after the verb.

    Returns:
        Hydra's flags, which must precede all overrides; the overrides; and the values of the flags.

    Raises:
        SystemExit: Code 2: a flag is unknown or lacks its value.
        InputError: An override deletes a key or group that the package reads, such as ``~data.size``.
    """
    parser = get_args_parser()
    parser.__class__ = _Parser
    values = parser.parse_intermixed_args(list(arguments))
    if values.shell_completion:  # Hydra's completion calls the program without its verb
        parser.error("--shell-completion: ghgs has none")
    for key in (text[1:].split("=", 1)[0] for text in values.overrides if text.startswith("~")):
        if key in _LIGHTNING or not is_below(key, _LIGHTNING):
            raise InputError(f"{key}: expected a value (or null where it may be empty); found ~{key}")
    flags = [word for word in arguments if word not in values.overrides]
    return flags, values.overrides, values


def check_directory(arguments: Sequence[str], sweeps: bool) -> None:
    """Reject a directory that Hydra ignores: that of a single run in a sweep, or vice versa.

    Args:
        arguments: Overrides of the command line.
        sweeps: Whether the command is a sweep.

    Raises:
        InputError: Only the directory of the other mode is given.
    """
    given = dict(text.lstrip("+").split("=", 1) for text in arguments if "=" in text)
    names = ["hydra.run.dir", "hydra.sweep.dir"]
    ignored, read = names if sweeps else names[::-1]
    expected = f"{read}, where {'a sweep' if sweeps else 'a single run (without -m)'} writes"
    require(read in given or ignored not in given, ignored, expected, given.get(ignored))


@interruptible()
def work(cfg: DictConfig, name: str, argv: Sequence[str]) -> object:
    """Check the configuration and do the work of a verb, in this process or in that of a launcher.

    Args:
        cfg: Configuration composed by Hydra.
        name: Name of the verb.
        argv: Command-line arguments, program and verb first.

    Returns:
        Return value of the verb.

    Raises:
        SystemExit: Bad input, outside a sweep; the message is printed, and an empty directory is
            removed.
    """
    # Lightning starts the other processes of a DDP job with sys.argv, which must contain the verb.
    sys.argv = list(argv)
    hydra_node = HydraConfig.get()
    directory = RunDirectory(Path(hydra_node.runtime.output_dir))
    is_single = hydra_node.mode == RunMode.RUN
    try:
        if is_single:  # a file may set hydra.mode
            check_directory(hydra_node.overrides.hydra, sweeps=False)
        check_ablation(cfg, hydra_node)
        is_given = any(word.lstrip("+").startswith("overwrite=") for word in argv)
        fits = is_given or not cfg.get("overwrite")
        require(fits, "overwrite", "a value on the command line alone", "true in a file")
        verb = verb_class(name).begin(to_plain(cfg))
        verb.require_files()
        verb.complete(to_plain(fill(cfg)))  # before slow imports of the verb
        is_dry = getattr(verb, "dry_run", False)
        if verb.begins_run and not is_dry:
            directory.start(verb)
        if not is_dry:
            require_no_links(directory.path, (*WRITTEN, f"{hydra_node.job.name}.log"))
        collect_garbage_again()
        let_children_sleep()
        return verb.run()
    except BAD_INPUT as error:
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            error.filename = str(directory.path)  # of a full disk, for example
        if is_single:
            # Hydra would print a line about errors that leave its job.
            print(f"ghgs {name}: {format_error(error, name)}", file=sys.stderr)
            raise SystemExit(1) from error
        raise
    finally:
        with contextlib.suppress(OSError):  # not empty
            if directory.path != Path.cwd():
                directory.path.rmdir()


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


def _print_configuration(name: str, overrides: list[str], values: argparse.Namespace) -> None:
    """Print the output of Hydra's ``--cfg job``, including the defaults of options.

    ``name`` is the verb or the value of ``--config-name``; ``values`` holds the flags ``--config-dir`` and
    ``--resolve``.
    """
    cfg = compose(name, overrides, with_hydra=True, folder=values.config_dir)
    HydraConfig.instance().set_config(cfg)
    cfg = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    read_nodes(OmegaConf.to_container(cfg, resolve=True))
    print(OmegaConf.to_yaml(cfg, resolve=values.resolve), end="")


def _run(verb: str, argv: list[str]) -> None:
    """Parse the arguments, and print help or the configuration or start Hydra's application."""
    flags, overrides, values = parse_arguments(argv[2:])
    if values.help:
        words = [word for word in overrides if "=" in word]
        groups = [word for word in overrides if "=" not in word]
        print_help(verb, groups, _rewrite_overrides(verb, words), values.config_dir)
        return
    store_defaults(verb, values.config_dir)
    overrides = _rewrite_overrides(verb, overrides)
    if values.cfg == "job" and values.package is None:
        _print_configuration(values.config_name or verb, overrides, values)
        return
    if values.multirun or "hydra.mode=MULTIRUN" in overrides:
        check_directory(overrides, sweeps=True)
    sys.argv = [argv[0], *flags, *overrides, NO_FILES_OF_HYDRA]
    task = partial(work, name=verb, argv=argv)
    hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name=verb)(task)()


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
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        with interruptible():  # around the handling of errors: an interruption may look like one
            _run(verb, argv)
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has closed the pipe; Python must not flush the rest at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except Exception as error:
        if not is_bad_input(error):
            raise
        print(f"ghgs {verb}: {format_error(error, verb)}", file=sys.stderr)
        return 1
    return 0
