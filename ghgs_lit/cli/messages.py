"""One-line error messages: ``<path or key>: expected ...; found ...``."""

import argparse
import difflib
import errno
import os
import re
import shlex
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path

from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ghgs_lit.config import compose, conf_dir
from ghgs_lit.config.keys import flatten, is_below
from ghgs_lit.config.options import UnknownKey, did_you_mean
from ghgs_lit.config.registry import KINDS, verb_class, verbs
from ghgs_lit.errors import InputError, require

#: Errors that indicate bad input rather than a bug.
BAD_INPUT = (InputError, OSError, HydraException, OmegaConfBaseException)

_EXTRAS = {"joblib": "cluster", "submitit": "cluster"}

_FULL = (errno.ENOSPC, errno.EDQUOT)

#: Keeps Hydra from writing .hydra, which it does through links;
#: :func:`ghgs_lit.cli.application.write_hydra_files` replaces it.
NO_FILES_OF_HYDRA = "hydra.output_subdir=null"

#: Nodes of Lightning's classes; their keys have defaults, so they may be deleted.
_LIGHTNING = ("trainer", "callbacks", "logger")


def format_error(error: Exception, verb: str) -> str:
    """Message of an error on one line.

    Args:
        error: One of :data:`BAD_INPUT`, or an error raised inside Hydra.
        verb: Name of the verb; its keys are suggested for misspelt ones.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        text = _explain_missing_option(error)
    elif isinstance(error, OverrideParseException):
        text = _explain_override(error)
    elif isinstance(error, HydraException):
        text = _explain_composition(error, verb)
    elif isinstance(error, OSError):
        text = _explain_system_error(error)
    elif isinstance(error, OmegaConfBaseException):
        text = f"{error.full_key}: expected a value that can be resolved; found {error.msg}"
    elif isinstance(error, UnknownKey) and any(word.startswith(f"{error.key}=") for word in sys.argv[1:]):
        text = _explain_unknown_key(error.key, verb)
    elif isinstance(error, InputError):
        text = str(error)
    else:  # an error of Hydra without the name of the override
        text = _explain_numeric_option()
        text = text or f"{_command_line()}: expected overrides that Hydra can apply; found {error}"
    return " ".join(text.split())


def _explain_numeric_option() -> str | None:
    """Message for the first group whose option is a number or null, such as ``views=4``: Hydra's error
    contains neither group nor value. None if there is no such override."""
    for word in sys.argv[1:]:
        group, _, value = word.partition("=")
        if (conf_dir() / group).is_dir() and re.fullmatch(r"[\d.,]+|null", value):
            known = sorted(path.stem for path in (conf_dir() / group).glob("*.yaml"))
            hint = did_you_mean(value.partition(",")[0], known)
            return f"{group}: expected one of {', '.join(known)}; found {value}{hint}"
    return None


def _command_line() -> str:
    return " ".join(word for word in sys.argv[1:] if word != NO_FILES_OF_HYDRA)


def _explain_override(error: OverrideParseException) -> str:
    key, sign, value = str(error.override).partition("=")
    if not sign or not value or value[0] in "[{\"'":
        named = error.override if sign else key
        return f"{named}: expected key=value or group=option; found {error if sign else 'no ='}"
    quoted = shlex.quote(f'{key}="{value}"')
    return (
        f"{key}: expected quotes around such a value, two kinds because of the shell: {quoted}; found {value}"
    )


def _explain_missing_option(error: MissingConfigException) -> str:
    """Message for an unknown group or option, in place of Hydra's, which lists the whole search path."""
    group, _, option = error.missing_cfg_file.rpartition("/")
    if not group:
        return f"--config-name: expected a configuration of the search path; found {option!r}"
    known = sorted(error.options or ())
    expected = f"one of {', '.join(known)}" if known else "a group that has options"
    extra = next((extra for name, extra in _EXTRAS.items() if option.startswith(name)), None)
    hint = did_you_mean(option, known) or (f" (pip install 'ghgs-lit[{extra}]')" if extra else "")
    return f"{group}: expected {expected}; found {option!r}{hint}"


def _explain_composition(error: HydraException, verb: str) -> str:
    """Message for an unknown key, with the closest known one, or for another composition error of Hydra."""
    if chosen := re.match(r"In '([^']+)': Could not override 'ablation'", str(error)):
        expected = "no choice of an ablation, which composes last (ablation=... on the command line)"
        return f"{chosen[1]}: expected {expected}; found one"
    if several := re.match(r"Ambiguous value for argument '([^=']+)=(.*)'\n", str(error)):
        key, values = several.groups()
        return f"{key}: expected one value, a list ([{values}]), or -m for a run of each; found {values}"
    named = re.match(r"Could not override '([^']+)'", str(error))
    if named is None:
        return f"{_command_line()}: expected overrides that fit; found {error} {error.__cause__ or ''}"
    return _explain_unknown_key(named[1], verb)


def _explain_unknown_key(key: str, verb: str) -> str:
    """Message for an unknown key, with the closest known one.

    A name is compared with names only, never with a whole dotted key, because a shared group would make
    all its keys similar. A misspelt group is corrected first: ``optimzer.lrr`` is looked up in
    ``optimizer``.
    """
    text = f"{key}: expected a key or group of this verb; found none of that name"
    if any(key in verb_class(name).model_fields for name in verbs()):
        return text  # it belongs to another verb
    groups = {str(path.relative_to(conf_dir())) for path in conf_dir().rglob("*") if path.is_dir()}
    chosen = [word for word in sys.argv[1:] if word.partition("=")[0] in groups and "," not in word]
    keys = _keys(verb, chosen) or _keys(verb)
    names = dict.fromkeys((*groups, *KINDS, *(known.partition(".")[0] for known in keys)))
    group, dot, rest = key.partition(".")
    if dot:
        group = "".join(difflib.get_close_matches(group, names, 1)) or group
        known_as = {known.removeprefix(f"{group}."): known for known in keys}
    else:  # also match a key without its group: lr for optimizer.lr
        rest = key
        known_as = {known.rpartition(".")[2]: known for known in keys} | {name: name for name in names}
    close = difflib.get_close_matches(rest, known_as, 1)
    return f"{text} (did you mean {known_as[close[0]]}?)" if close else text


def _keys(verb: str, overrides: Sequence[str] = ()) -> list[str]:
    """All dotted keys of a verb with some overrides; empty if the configuration cannot be composed."""
    try:
        return list(flatten(OmegaConf.to_container(compose(verb, overrides), resolve=False)))
    except (HydraException, OmegaConfBaseException, InputError):
        return []


def _explain_system_error(error: OSError) -> str:
    """Message for a file that cannot be read or written; with the run's directory if the error contains
    no path."""
    if error.errno is None:  # raised by this package with a complete message
        return str(error)
    path = error.filename2 or error.filename
    if path is None:
        path = HydraConfig.get().runtime.output_dir if HydraConfig.initialized() else Path.cwd()
    if isinstance(error, FileExistsError | NotADirectoryError):
        return f"{os.fsdecode(path)}: expected a path below folders; found a file in its place or above it"
    if error.errno in _FULL:
        return f"{os.fsdecode(path)}: expected space on its disk; found it full ({error.strerror})"
    reason = error.strerror or error
    return f"{os.fsdecode(path)}: expected a file that can be read or written; found {reason}"


def print_thread_error(arguments: threading.ExceptHookArgs) -> None:
    """Exception hook of threads: print the error unless the disk is full.

    TensorBoard's writer thread raises such an error again where values are logged.
    """
    if getattr(arguments.exc_value, "errno", None) not in _FULL:
        threading.__excepthook__(arguments)


def is_raised_by_hydra(error: Exception) -> bool:
    """Whether an error concerns the command line: raised in Hydra's or OmegaConf's code, or by the YAML
    parser."""
    if isinstance(error, YAMLError):
        return True
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return innermost.f_globals.get("__name__", "").split(".")[0] in ("hydra", "omegaconf")


class BadUsage(Exception):
    """Unknown flag, or a flag without its value."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:
        raise BadUsage(f"{message} (--hydra-help lists the flags)")


def parse_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str], argparse.Namespace]:
    """Split the arguments of a verb.

    Args:
        arguments: Command-line arguments after the verb.

    Returns:
        Hydra's flags, which must precede all overrides; the overrides; and the values of the flags.

    Raises:
        BadUsage: A flag is unknown or lacks its value.
    """
    parser = get_args_parser()
    parser.__class__ = _Parser
    values = parser.parse_intermixed_args(list(arguments))
    if values.shell_completion:  # Hydra's completion calls the program without its verb
        parser.error("--shell-completion: ghgs has none")
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


def check_deletions(arguments: Sequence[str]) -> None:
    """Reject deletions of keys or groups that the package reads, such as ``~data.size``.

    Raises:
        InputError: The message contains the first such key.
    """
    for key in (text[1:].split("=", 1)[0] for text in arguments if text.startswith("~")):
        if key in _LIGHTNING or not is_below(key, _LIGHTNING):
            raise InputError(f"{key}: expected a value (or null where it may be empty); found ~{key}")
