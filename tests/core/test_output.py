"""If standard output or error can't be written, the work continues."""

import io
import os
import sys

import pytest

from threestudio_gaussiandreamer.core.command import tolerant_output


def text_file(path, encoding="utf-8") -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BufferedWriter(io.FileIO(path, "w")), encoding=encoding)


def test_characters_that_the_terminal_does_not_have_are_written_as_escapes(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdout", text_file(tmp_path / "out.txt", encoding="ascii"))
    with tolerant_output():
        print("ein Fuchs, grün")
    assert (tmp_path / "out.txt").read_text() == "ein Fuchs, gr\\xfcn\n"


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
    """Python sets it to None, as after ``command >&-``."""
    monkeypatch.setattr(sys, name, None)
    with tolerant_output():
        stream = getattr(sys, name)
        print("unread", file=stream, flush=True)
        assert not stream.isatty()
    assert getattr(sys, name) is None and stream.closed
