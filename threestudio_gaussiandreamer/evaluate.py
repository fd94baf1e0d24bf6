"""Score finished assets: the command ``python -m threestudio_gaussiandreamer.evaluate``."""

import sys

from .evaluation.scorecard import main

if __name__ == "__main__":
    sys.exit(main())
