"""Exit codes and messages of the package's commands."""

import contextlib
import os
import sys

import pytest

from threestudio_gaussiandreamer.core.command import exit_code, run_command, run_main
from threestudio_gaussiandreamer.core.errors import UserError


def raising(error):
    def run(args):
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (UserError("no such file"), 2, "error: no such file\n"),
        (KeyboardInterrupt(), 130, "stopped\n"),
        (BrokenPipeError(32, "Broken pipe"), 141, "the reader of the output has closed it"),
    ],
)
def test_what_ends_a_command_is_one_message(error, code, message, capsys, monkeypatch):
    monkeypatch.setattr(os, "dup2", lambda *descriptors: None)
    assert run_command(len, raising(error), []) == code
    assert message in capsys.readouterr().err


def test_an_internal_error_keeps_its_traceback_in_verbose_mode():
    with pytest.raises(ZeroDivisionError):
        run_command(len, raising(ZeroDivisionError()), [])


def test_nobody_reads_the_message_about_a_closed_pipe_either(monkeypatch):
    """As after ``command 2>&1 | head``."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    broken = open(write_end, "w", buffering=1)
    monkeypatch.setattr(sys, "stderr", broken)
    monkeypatch.setattr(os, "dup2", lambda *descriptors: None)
    error = BrokenPipeError(32, "Broken pipe")
    assert exit_code(error) == 141
    with contextlib.suppress(BrokenPipeError):
        broken.close()


def test_the_exit_code_is_that_of_the_work_without_a_standard_output(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    assert run_command(len, lambda args: print("unread"), []) == 0


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Write a module that can be imported, and forget it afterwards."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(text):
        (tmp_path / "command_of_a_test.py").write_text(text)
        return "command_of_a_test"

    yield write
    sys.modules.pop("command_of_a_test", None)


def test_a_command_is_imported_and_run(module):
    assert run_main(module("def main():\n    return 7")) == 7


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_during_the_import_is_one_line(module, name, code, lost, capsys):
    """Some libraries catch what is raised while they are imported."""
    stop = f"os.kill(os.getpid(), signal.{name})"
    if lost:
        stop = f"try:\n    {stop}\nexcept BaseException:\n    pass"
    assert run_main(module(f"import os, signal\n{stop}\ndef main():\n    return 7")) == code
    assert capsys.readouterr().err == "stopped\n"
