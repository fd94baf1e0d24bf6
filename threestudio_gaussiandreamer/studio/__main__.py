"""Run ``python -m threestudio_gaussiandreamer.studio``."""

import sys

from ..core.command import run_main


def console() -> None:
    """Run the console script."""
    sys.exit(run_main(f"{__package__}.server"))


if __name__ == "__main__":
    console()
