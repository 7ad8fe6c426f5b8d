"""Errors as one line: ``<path or key>: expected ...; found ...``."""

import argparse
import difflib
import os
import re
import sys
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import is_below
from ghgs_lit.config.registry import option_keys
from ghgs_lit.config.schema import KINDS
from ghgs_lit.errors import InputError

#: Errors that are bad input, not bugs: files that cannot be read or written are, too.
BAD_INPUT = (InputError, OSError, HydraException, OmegaConfBaseException)

_EXTRAS = {"joblib": "cluster", "submitit": "cluster", "ray": "ray", "optuna": "optuna"}


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`` (did you mean ...?)`` with the closest of ``known``, or nothing."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {close[0]}?)" if close else ""


def one_line(error: Exception) -> str:
    """The message of one of ``BAD_INPUT`` or of an error inside Hydra, on one line."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        text = _missing_option(error)
    elif isinstance(error, OverrideParseException):
        text = f"{error.override}: expected key=value or group=option; found {error}"
    elif isinstance(error, HydraException):
        text = _composition(error)
    elif isinstance(error, OSError):
        text = _system(error)
    elif isinstance(error, OmegaConfBaseException):
        text = f"{error.full_key}: expected a value that can be resolved; found {error.msg}"
    elif isinstance(error, InputError):
        text = str(error)
    else:  # of Hydra, which does not say which override it refuses
        text = f"{' '.join(sys.argv[1:])}: expected overrides that Hydra can apply; found {error}"
    return " ".join(text.split())


def _missing_option(error: MissingConfigException) -> str:
    """A group without the chosen option, or no such group; Hydra lists its whole search path."""
    group, _, option = error.missing_cfg_file.rpartition("/")
    if not group:
        return f"--config-name: expected a configuration of the search path; found {option!r}"
    known = sorted(error.options or ())
    expected = f"one of {', '.join(known)}" if known else "a group that has options"
    extra = next((extra for name, extra in _EXTRAS.items() if option.startswith(name)), None)
    hint = did_you_mean(option, known) or (f" (the extra {extra} has it)" if extra else "")
    return f"{group}: expected {expected}; found {option!r}{hint}"


def _composition(error: HydraException) -> str:
    """A key that does not exist, with the closest one; other errors of Hydra with their cause."""
    named = re.match(r"Could not override '([^']+)'", str(error))
    if named is None:
        return f"{' '.join(sys.argv[1:])}: expected overrides that fit; found {error} {error.__cause__ or ''}"
    key = named[1]
    # A key without its group counts as close, too: lr for optimizer.lr.
    keys = [*(known for known in KINDS if "*" not in known), *option_keys()]
    whole = {known.rpartition(".")[2]: known for known in keys}.get(key)
    hint = f" (did you mean {whole}?)" if whole else did_you_mean(key, (*keys, *_groups()))
    hint = "" if key in keys else hint  # a key of another verb
    return f"{key}: expected a key or group of this verb; found none of that name{hint}; +{key}=... adds it"


def _groups() -> list[str]:
    """The names of the groups in ``conf``."""
    return [str(path.relative_to(conf_dir())) for path in conf_dir().rglob("*") if path.is_dir()]


def _system(error: OSError) -> str:
    """A file that cannot be read or written. Where the system names none it is the run's directory."""
    if error.errno is None:  # raised by this package, with a message of its own
        return str(error)
    place = error.filename2 or error.filename
    if place is None:
        place = HydraConfig.get().runtime.output_dir if HydraConfig.initialized() else Path.cwd()
    return (
        f"{os.fsdecode(place)}: expected a file that can be read or written; found {error.strerror or error}"
    )


def raised_by_hydra(error: Exception) -> bool:
    """Whether an error of any type was raised in Hydra's own code: it is about the command line."""
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return innermost.f_globals.get("__name__", "").split(".")[0] in ("hydra", "omegaconf")


class BadUsage(Exception):
    """Hydra's parser refuses the flags of a command line."""


def check_flags(arguments: Sequence[str]) -> None:
    """Refuse what Hydra's parser of ``arguments`` would refuse with its whole usage.

    Raises:
        BadUsage: the reason, as one line.
    """

    def refuse(reason: str) -> NoReturn:
        unknown = re.match(r"unrecognized arguments: (.*)", reason)
        if unknown is None:
            raise BadUsage(f"expected flags as --hydra-help lists them; found {reason}")
        if unknown[1].startswith("-"):
            flag = unknown[1].split()[0].split("=")[0]
            raise BadUsage(f"{flag}: expected a flag of --hydra-help; found none of that name")
        raise BadUsage(
            "expected flags such as -m and --config-dir before or after all key=value arguments, not"
            f" between them; found a flag before {unknown[1]!r}"
        )

    parser: argparse.ArgumentParser = get_args_parser()
    parser.error = refuse
    parser.parse_args(list(arguments))


#: Nodes of Lightning's classes, whose keys have values of their own where none is given.
_LIGHTNING = ("trainer", "callbacks", "logger")


def check_deletions(arguments: Sequence[str]) -> None:
    """Refuse to delete single keys (``~data.size``), which the package reads; groups can be deleted.

    Raises:
        InputError: names the key.
    """
    for key in (text[1:].split("=", 1)[0] for text in arguments if text.startswith("~")):
        if "." in key and not is_below(key, _LIGHTNING):
            raise InputError(f"{key}: expected a value (or null where it may be empty); found ~{key}")
