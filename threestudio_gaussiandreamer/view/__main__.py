"""Run ``python -m threestudio_gaussiandreamer.view PATH``."""

import sys

from .command import main

sys.exit(main())
