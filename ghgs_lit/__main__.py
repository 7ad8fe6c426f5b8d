"""``python -m ghgs_lit`` is ``ghgs``."""

import sys

from ghgs_lit.cli.main import main

sys.exit(main())
