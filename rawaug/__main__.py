"""``python -m rawaug``."""

from __future__ import annotations

import sys

from rawaug.cli import main

sys.exit(main())
