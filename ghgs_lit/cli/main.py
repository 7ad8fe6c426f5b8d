"""Entry point of ``ghgs <verb> [overrides]``; :mod:`ghgs_lit.cli.application` runs the verb."""

import gc
import os
import signal
import sys

from ghgs_lit.errors import InputError
from ghgs_lit.runs.processes import Interrupted, interruptible
from ghgs_lit.runtime.allocation import collect_garbage_again, keep_freed_memory
from ghgs_lit.runtime.cores import spin_if_alone


def _command(argv: list[str]) -> int:
    """Run a command and return the exit code, see :func:`main`."""
    if len(argv) < 2 or argv[1] in ("-h", "--help", "help"):
        from ghgs_lit.cli.help import usage  # here: imports pydantic

        print(usage())
        return 0 if len(argv) > 1 else 2
    if argv[1] == "--version":
        from importlib.metadata import version  # here: --help does not need it

        print(version("ghgs-lit"))
        return 0
    from ghgs_lit.config.options import did_you_mean
    from ghgs_lit.config.registry import VERBS, verbs

    if argv[1] not in VERBS and argv[1] not in verbs():
        hint = did_you_mean(argv[1], verbs())
        print(f"ghgs: expected a verb ({', '.join(verbs())}); found {argv[1]!r}{hint}", file=sys.stderr)
        return 2
    from ghgs_lit.cli.application import run  # here: imports Hydra

    return run(argv[1], argv)


def main() -> int:
    """Run the console script.

    Returns:
        Exit code: 0: success; 1: bad input; 2: bad usage; 130, 143: interrupted.
    """
    argv = list(sys.argv)
    # Schedulers and daemons may have closed standard output and error.
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    # OpenMP threads that spin while they wait slow down other processes on the same cores tenfold.
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "LOCAL_RANK"} & os.environ.keys():
        spin_if_alone(argv)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    keep_freed_memory()
    # Collecting garbage among imported modules takes a third of the start-up time.
    gc.disable()
    try:
        with interruptible():
            return _command(argv)
    except InputError as error:  # in a plug-in, before a verb is chosen
        print(f"ghgs: {error}", file=sys.stderr)
        return 1
    except Interrupted as stop:
        if not stop.explained:
            name = signal.Signals(stop.number).name
            print(f"{' '.join(['ghgs', *argv[1:2]])}: interrupted ({name})", file=sys.stderr)
        return stop.code
    except KeyboardInterrupt:  # raised by a library
        print(f"{' '.join(['ghgs', *argv[1:2]])}: interrupted", file=sys.stderr)
        return 130
    finally:
        collect_garbage_again()


if __name__ == "__main__":
    sys.exit(main())
