"""`make charts` draws every chart of docs/charts."""

import importlib
import re
from pathlib import Path

import pytest

from benchmarks.quality.runs import CHARTS, ROOT
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu


def commands() -> list[tuple[str, list[str]]]:
    """Return module and arguments of each command of the Makefile's target."""
    recipe = re.search(r"^charts:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    found = re.findall(r"python -m (\S+)(.*)", recipe[1])
    return [(module, arguments.split()) for module, arguments in found]


@pytest.mark.slow
@pytest.mark.skipif(bool(cpu.unavailable()), reason="the kernel isn't built")
def test_make_charts_draws_every_chart(monkeypatch):
    pytest.importorskip("matplotlib")
    drawn = set()

    def savefig(self, path, **_):
        drawn.add(Path(path))

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)
    for module, arguments in commands():
        monkeypatch.setattr("sys.argv", [module, *arguments])
        importlib.import_module(module).main()
    assert drawn == set(CHARTS.glob("*.png"))
