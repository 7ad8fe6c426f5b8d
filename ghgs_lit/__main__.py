"""Run ``ghgs`` as ``python -m ghgs_lit``."""

import sys

from ghgs_lit.cli.main import main

sys.exit(main())
