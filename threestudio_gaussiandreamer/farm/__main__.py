"""Run ``python -m threestudio_gaussiandreamer.farm prompts.txt --config gaussiandreamer.yaml``."""

import sys

from ..core.command import run_main

sys.exit(run_main(f"{__package__}.command"))
