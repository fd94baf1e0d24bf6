"""Extensions that fail are named in the error message."""

import sys
from pathlib import Path

import pytest

from tests.stability.rows import row
from tests.stability.small_runs import launch
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

register_parts()


# ---- modules of the user -------------------------------------------------------------------------

MODULES = {
    "ImportError": ("import nothing_of_this_name", "custom/part.py:1: ModuleNotFoundError"),
    "syntax": ("def f(:", "custom/part.py:1: "),
    "an exception": ("\n\nraise RuntimeError('broken')", "custom/part.py:3: RuntimeError: broken"),
    "sys.exit()": ("import sys\nsys.exit()", "custom/part.py:2: SystemExit"),
    "sys.exit(0)": ("import sys\nsys.exit(0)", "custom/part.py:2: SystemExit: 0"),
    "a name that is taken": (
        "from threestudio_gaussiandreamer.host import register\n@register('mesh-prior')\nclass "
        "Mine: pass",
        "custom/part.py:2",
    ),
}


@row("A5", "Failed custom module")
@pytest.mark.parametrize("what", MODULES)
def test_a_module_that_fails_is_named_with_its_line(what, tmp_path, monkeypatch, measured):
    source, message = MODULES[what]
    monkeypatch.chdir(tmp_path)
    Path("custom").mkdir()
    Path("custom/part.py").write_text(source)
    ended = launch(tmp_path / "out", "trainer.max_steps=1")
    assert ended.code == 2 and "can't be imported" in ended.err and message in ended.err, ended.err
    assert "Traceback" not in ended.err and not (tmp_path / "out").exists()
    measured("named error at load")


@row("A5", "Failed custom module")
def test_a_signal_while_a_module_is_imported_is_not_its_fault(tmp_path, monkeypatch, measured):
    monkeypatch.chdir(tmp_path)
    Path("custom").mkdir()
    Path("custom/part.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)")
    ended = launch(tmp_path / "out", "trainer.max_steps=1")
    assert ended.code == 143 and "can't be imported" not in ended.err
    measured("SIGTERM stays SIGTERM")


@row("A5", "Failed custom module")
def test_a_part_that_calls_sys_exit_in_the_middle_of_a_run_is_named(
    tmp_path, monkeypatch, measured
):
    """``sys.exit()`` means success, but the run is incomplete."""
    monkeypatch.setattr(GaussianDreamerSystem, "training_step", lambda *args: sys.exit())
    ended = launch(tmp_path, "trainer.max_steps=1")
    assert (
        ended.code == 2
        and f"{Path(__file__).name}:" in ended.err
        and "ended the run with sys.exit(None)" in ended.err
    )
    measured("named, exit code 2")
