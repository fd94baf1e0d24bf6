"""What the tests of untrusted files share."""

from pathlib import Path

import threestudio_gaussiandreamer

PACKAGE = Path(threestudio_gaussiandreamer.__file__).parent
