"""Score finished assets: the command ``python -m threestudio_gaussiandreamer.evaluate``."""

import sys

from .core.command import run_main

if __name__ == "__main__":
    sys.exit(run_main(f"{__package__}.evaluation.scorecard"))
