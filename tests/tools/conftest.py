"""The tools are scripts beside each other, found as they are when one of them is run."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "tools"))
