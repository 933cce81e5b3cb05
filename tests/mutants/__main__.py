"""`python -m tests.mutants --count 300`: see campaign."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mutants.campaign import main

sys.exit(main())
