"""Helpers of the tests of untrusted files."""

from pathlib import Path

import threestudio_gaussiandreamer

PACKAGE = Path(threestudio_gaussiandreamer.__file__).parent
