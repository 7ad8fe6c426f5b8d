"""The command line in the process of the tests."""

import logging
import os
import sys

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
