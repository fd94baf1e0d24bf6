"""Exit codes and messages of the package's commands."""

import contextlib
import io
import os
import sys
import types

import pytest

from threestudio_gaussiandreamer.core.command import (
    exit_code,
    run_command,
    run_main,
    tolerant_output,
)
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


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Write a module that can be imported, and forget it afterwards."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(text):
        (tmp_path / "command_of_a_test.py").write_text(text)
        return "command_of_a_test"

    yield write
    sys.modules.pop("command_of_a_test", None)


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_during_the_import_is_one_line(module, name, code, lost, capsys):
    """Some libraries catch what is raised while they are imported."""
    stop = f"os.kill(os.getpid(), signal.{name})"
    if lost:
        stop = f"try:\n    {stop}\nexcept BaseException:\n    pass"
    assert run_main(module(f"import os, signal\n{stop}\ndef main():\n    return 7")) == code
    assert capsys.readouterr().err == "stopped\n"


# ---- if standard output or error can't be written, the work continues ---------------------------


def text_file(path, encoding="utf-8") -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BufferedWriter(io.FileIO(path, "w")), encoding=encoding)


def test_characters_that_the_terminal_does_not_have_are_written_as_escapes(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdout", text_file(tmp_path / "out.txt", encoding="ascii"))
    with tolerant_output():
        print("ein Fuchs, grün")
    assert (tmp_path / "out.txt").read_text() == "ein Fuchs, gr\\xfcn\n"
    logger = types.SimpleNamespace(write=(written := []).append, flush=lambda: None)
    monkeypatch.setattr(sys, "stdout", logger)
    with tolerant_output():
        print("grün")
    assert "".join(written) == "grün\n"


def buffered(descriptor):
    return open(descriptor, "w", closefd=False)


def unbuffered(descriptor):
    return io.TextIOWrapper(io.FileIO(descriptor, "w", closefd=False), write_through=True)


@pytest.mark.parametrize("opened", [buffered, unbuffered])
def test_a_full_device_is_reported_once_on_the_other_stream(capfd, monkeypatch, opened):
    descriptor = os.dup(1)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, 1)
    monkeypatch.setattr(sys, "stdout", opened(1))
    try:
        with tolerant_output():
            for _ in range(3):
                print("a line", flush=True)
    finally:
        os.dup2(descriptor, 1)
        os.close(descriptor)
        os.close(full)
    expected = "standard output can't be written (No space left on device): going on without it"
    assert capfd.readouterr().err == f"{expected}\n"


def test_a_terminal_that_was_closed_takes_any_text(monkeypatch):
    main_end, terminal = os.openpty()
    stream = open(terminal, "w")
    monkeypatch.setattr(sys, "stderr", stream)
    os.close(main_end)
    with pytest.raises(OSError):
        os.write(terminal, b"x")
    with tolerant_output():
        print("unread", file=sys.stderr, flush=True)


def test_a_closed_pipe_is_still_an_error(monkeypatch):
    read_end, write_end = os.pipe()
    os.close(read_end)
    monkeypatch.setattr(sys, "stdout", open(write_end, "w"))
    with pytest.raises(BrokenPipeError):
        with tolerant_output():
            print("a line", flush=True)
    os.dup2(os.open(os.devnull, os.O_WRONLY), write_end)  # what is left in the buffers goes there


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_stream_that_was_closed_before_the_start_takes_any_text(monkeypatch, name):
    """Python sets it to None, as after ``command >&-``; the exit code is that of the work."""
    monkeypatch.setattr(sys, name, None)
    with tolerant_output():
        stream = getattr(sys, name)
        print("unread", file=stream, flush=True)
        assert not stream.isatty()
    assert getattr(sys, name) is None and stream.closed
    assert run_command(len, lambda args: print("unread", file=getattr(sys, name)), []) == 0
