"""No figure of ``tools/size.py`` is above its ceiling."""

import subprocess
import sys

import pytest

from tests import architecture
from tools import size


@pytest.mark.parametrize("more", [[], pytest.param(["--frames"], marks=pytest.mark.slow)], ids=str)
def test_no_figure_is_above_its_ceiling(more):
    command = [sys.executable, "-m", "tools.size", *more]
    done = subprocess.run(command, cwd=architecture.ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert not more or "frames to the U-Net" in done.stdout


def test_circles_and_private_names_are_found(tmp_path, monkeypatch):
    package = tmp_path / "package"
    package.mkdir()
    (package / "a.py").write_text("from . import b\nself._x = other._y._z\n")
    (package / "b.py").write_text("if TYPE_CHECKING:\n    from .a import A\n")
    (package / "c.py").write_text("from .a import A\n\n\ndef f():\n    from .d import D\n")
    (package / "d.py").write_text("from .c import C\n")
    for name, value in {"ROOT": tmp_path, "PACKAGE": package, "NAME": "package"}.items():
        monkeypatch.setattr(architecture, name, value)
        monkeypatch.setattr(size, name, value, raising=False)
    architecture.modules.cache_clear()
    try:
        assert size.circles() == 1 and size.others_private(package) == 2
    finally:
        architecture.modules.cache_clear()
