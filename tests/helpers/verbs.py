"""The command line in the process of the tests."""

import logging
import os
import sys

from hydra.core.global_hydra import GlobalHydra

from ghgs_lit.cli.main import main


def ghgs(*arguments: str) -> int:
    """Run ``ghgs <arguments>``; return its exit code."""
    before = sys.argv
    sys.argv = ["ghgs", *arguments]
    # Set by the entry point; if a user has set it, errors are raised.
    os.environ.pop("HYDRA_FULL_ERROR", None)
    try:
        return main()
    except SystemExit as exit:
        return exit.code
    finally:
        sys.argv = before
        # The log file of the verb is opened at its first line, which could come from another test.
        for handler in list(logging.getLogger().handlers):
            if isinstance(handler, logging.FileHandler):
                logging.getLogger().removeHandler(handler)
                handler.close()


def succeed(capsys, *arguments: str) -> str:
    """Standard output of ``ghgs <arguments>``, which must succeed."""
    GlobalHydra.instance().clear()
    code = ghgs(*arguments)
    out, err = capsys.readouterr()
    assert not code, err
    return out


def refuse(capsys, *arguments: str) -> str:
    """Error of ``ghgs <arguments>``, which must be one line with exit code 1."""
    GlobalHydra.instance().clear()
    code = ghgs(*arguments)
    err = capsys.readouterr().err
    assert (code, err.count("\n")) == (1, 1), err
    return err
