"""Run ``python -m threestudio_gaussiandreamer.studio``."""

import sys

from ..core.command import run_main

sys.exit(run_main(f"{__package__}.server"))
