"""The harness is no part of the package, so it is found beside it."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)  # behind the rest: an installed zstate stays the one that is tested
