"""Run a verb as a Hydra application of ``conf/<verb>.yaml``."""

import contextlib
import os
import re
import signal
import sys
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.cli import messages
from ghgs_lit.cli.help import print_help
from ghgs_lit.config import VERSION_BASE, compose, conf_dir
from ghgs_lit.config.compose import check_ablation, store_defaults, to_plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.reading import read_as_ghgs
from ghgs_lit.config.registry import read_nodes, verb_class
from ghgs_lit.errors import require
from ghgs_lit.files import require_no_links
from ghgs_lit.runs.job import register_resolvers
from ghgs_lit.runs.processes import interruptible
from ghgs_lit.runs.run import WRITTEN, RunDirectory
from ghgs_lit.runtime.allocation import collect_garbage_again
from ghgs_lit.runtime.cores import let_children_sleep

register_resolvers()  # on import, so that the processes of a launcher have them too
read_as_ghgs()


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
            messages.check_directory(hydra_node.overrides.hydra, sweeps=False)
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
    except messages.BAD_INPUT as error:
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            error.filename = str(directory.path)  # of a full disk, for example
        if is_single:
            # Hydra would print a line about errors that leave its job.
            print(f"ghgs {name}: {messages.format_error(error, name)}", file=sys.stderr)
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


def _print_configuration(name: str, overrides: list[str], values: Namespace) -> None:
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
    flags, overrides, values = messages.parse_arguments(argv[2:])
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
        messages.check_directory(overrides, sweeps=True)
    sys.argv = [argv[0], *flags, *overrides, messages.NO_FILES_OF_HYDRA]
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
        if not messages.is_bad_input(error):
            raise
        print(f"ghgs {verb}: {messages.format_error(error, verb)}", file=sys.stderr)
        return 1
    return 0
