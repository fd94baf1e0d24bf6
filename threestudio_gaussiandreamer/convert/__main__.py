"""Run ``python -m threestudio_gaussiandreamer.convert IN OUT``."""

import sys

from .command import main

sys.exit(main())
