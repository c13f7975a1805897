"""``python -m flockopt``."""

from __future__ import annotations

import sys

from flockopt.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
