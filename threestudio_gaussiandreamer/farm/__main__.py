"""Run ``python -m threestudio_gaussiandreamer.farm prompts.txt --config gaussiandreamer.yaml``."""

import sys

from .command import main

sys.exit(main())
