"""Run ``python -m threestudio_gaussiandreamer.prune IN OUT``."""

import sys

from .command import main

sys.exit(main())
