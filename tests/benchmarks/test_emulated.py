"""The kernel for Linux on ARM, under emulation."""

import shutil

import pytest

from benchmarks.splatting import emulated


@pytest.mark.slow
def test_the_kernel_for_arm_draws_the_same_in_emulation():
    for tool in (emulated.COMPILER, emulated.EMULATOR):
        if shutil.which(tool) is None:
            pytest.skip(f"needs {tool}")
    assert emulated.main() == 0


def test_what_is_missing_is_named(monkeypatch, capsys):
    monkeypatch.setattr(emulated, "COMPILER", "no-such-compiler")
    assert emulated.main() == 0
    assert capsys.readouterr().out == "skipped: needs no-such-compiler\n"
