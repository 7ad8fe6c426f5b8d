"""Arguments of a verb, checks of them, and one-line error messages:
``<path or key>: expected ...; found ...``."""

import argparse
import re
import sys
import traceback
from collections.abc import Sequence

from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import is_below
from ghgs_lit.config.options import did_you_mean
from ghgs_lit.config.registry import KINDS, verb_class
from ghgs_lit.errors import InputError, require

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
