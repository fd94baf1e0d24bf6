"""A real threestudio on this machine: ``THREESTUDIO_SRC`` (a checkout of v0.2.3), ``HOST3_DIR``
(where the harness has put its environment), and the harness, in ``GAUSSIANDREAMER_SHARED`` or
``../shared``."""

import os
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("GAUSSIANDREAMER_SHARED", REPOSITORY.parent / "shared"))
HARNESS = SHARED / "real_host" / "try_extension.sh"
HOST = Path(os.environ.get("HOST3_DIR", "no such folder"))
SOURCE = os.environ.get("THREESTUDIO_SRC", "")

NEEDED = [
    pytest.mark.slow,
    pytest.mark.skipif(not SOURCE, reason="THREESTUDIO_SRC isn't set"),
    pytest.mark.skipif(not HARNESS.is_file(), reason="the harness isn't there"),
    pytest.mark.skipif(not (HOST / "venv").is_dir(), reason="HOST3_DIR has no environment"),
]
"""The ``pytestmark`` of a module whose tests run in it."""


def output_of(module: str, *arguments: str | Path) -> str:
    """Run a module of the tests beside threestudio, in its environment; return what it printed."""
    places = [HARNESS.parent / "stubs", REPOSITORY, SOURCE, os.environ.get("EXTRA_PYTHONPATH", "")]
    path = os.pathsep.join(str(place) for place in places if str(place))
    options = {"HOST3_PATCH": "1", "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": path}
    command = [HOST / "venv" / "bin" / "python", "-W", "ignore", "-m", module, *arguments]
    environment = {**os.environ, **options}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
