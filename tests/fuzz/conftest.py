"""The stand-in for a GPU is that of the stability tests."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "stability"))
