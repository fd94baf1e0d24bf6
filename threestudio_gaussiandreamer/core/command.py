"""Run a command-line program: exit codes, errors in the user's input as one message, and signals
that stop it: Ctrl-C, SIGTERM, and SIGHUP, which a closed terminal or a lost connection sends."""

import contextlib
import errno
import importlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NoReturn, Optional

from .errors import Terminated, UserError
from .extras import error_of_extra
from .launcher import require_numbers


def run_command(
    parse: Callable[[Optional[Sequence[str]]], Any],
    run: Callable[[Any], Any],
    argv: Optional[Sequence[str]] = None,
) -> int:
    """Parse a command line (None: that of this process), and call ``run`` with the arguments.

    Returns:
        the exit code: that of ``run``, if it returns one, 0 for success, 2 for wrong input, 141 for
        a closed pipe, 128 and the number of a stop signal, even if other code has caught or
        replaced the exception that it raised.
    """
    try:
        args = parse(argv)
    except SystemExit as stop:  # --help, or a mistake that argparse has printed
        return int(stop.code or 0)
    received: Sequence[int] = ()
    with tolerant_output():
        try:
            with raised_signals() as received:
                code = run(args)
                sys.stdout.flush()
                if not received:
                    return code if isinstance(code, int) else 0
        except (KeyboardInterrupt, Terminated) as stop:  # also of handlers of a caller's
            received = received or [getattr(stop, "code", 128 + signal.SIGINT) - 128]
        except BaseException as error:
            if not received:
                return exit_code(error, getattr(args, "verbose", False))
        print("stopped", file=sys.stderr)
    return 128 + received[0]


def run_main(module: str) -> int:
    """Import a module, which may be stopped, and return the exit code of its ``main()``."""
    mains: list[Callable[[], int]] = []

    def load(_: Any) -> None:
        require_numbers()
        mains.append(importlib.import_module(module).main)

    return run_command(lambda _: None, load) or mains[0]()


def exit_code(error: BaseException, verbose: bool = False) -> int:
    """Print one message about the error that ended a command, and return the exit code; raise it if
    it is no UserError, BrokenPipeError, ``sys.exit()``, or about a missing module of an extra.
    """
    if isinstance(error, SystemExit):
        error = foreign_exit(error)
    error = error_of_extra(error) or error
    if not isinstance(error, (UserError, BrokenPipeError)):
        raise error
    if verbose:
        traceback.print_exc()
    if isinstance(error, UserError):
        print(f"error: {error}", file=sys.stderr)
        return 2
    # The reader has closed the pipe, as `| head` does; without this, Python's flush at exit fails.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    said = f"stopped: the reader of the output has closed it ({error.strerror})"
    with contextlib.suppress(BrokenPipeError):  # after `2>&1 |` it has no reader either
        print(said, file=sys.stderr)
    return 128 + 13  # SIGPIPE, which Windows doesn't have


def foreign_exit(stop: SystemExit) -> UserError:
    """Make the error for a ``sys.exit()`` in a library or extension, whose code may be 0."""
    *_, place = traceback.extract_tb(stop.__traceback__)
    return UserError(f"{place.filename}:{place.lineno} ended the run with sys.exit({stop.code!r})")


def joined_values(
    argv: Optional[Sequence[str]], options: Sequence[str], values: Collection[str]
) -> list[str]:
    """Join each of these options by ``=`` to the value behind it, which argparse would take for an
    option if it begins with a hyphen; ``argv`` None means the arguments of this process.
    """
    joined: list[str] = []
    for word in sys.argv[1:] if argv is None else argv:
        # a wrong "-z" too, so that it is a wrong value and no missing one
        if joined and joined[-1] in options and {word, word.lstrip("-")} & {*values}:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


# -- signals ---------------------------------------------------------------------------------------


def set_handlers(handler: Callable[[int, Any], Any]) -> dict[int, Any]:
    """Install ``handler`` for the stop signals, but SIGHUP if it is ignored, as under ``nohup``;
    return the earlier handlers, none outside of the main thread, where Python doesn't allow this.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    signals = [signal.SIGINT, signal.SIGTERM]
    hang_up = getattr(signal, "SIGHUP", None)  # not on Windows
    if hang_up is not None and signal.getsignal(hang_up) != signal.SIG_IGN:
        signals.append(hang_up)
    return {signum: signal.signal(signum, handler) for signum in signals}


def restore_handlers(handlers: dict[int, Any]) -> None:
    """Restore the handlers that :func:`set_handlers` returned, once: the mapping is emptied."""
    while handlers:
        signal.signal(*handlers.popitem())


def interrupt(signum: int) -> NoReturn:
    """Raise KeyboardInterrupt for Ctrl-C and :class:`Terminated` for other signals."""
    raise KeyboardInterrupt if signum == signal.SIGINT else Terminated(128 + signum)


@contextlib.contextmanager
def raised_signals() -> Iterator[list[int]]:
    """Let stop signals raise exceptions in this context, so that ``finally`` blocks run; yield the
    list of those received, since an exception during an import may be replaced or lost.
    """
    received: list[int] = []

    def stop(signum: int, frame: Any) -> None:
        received.append(signum)
        interrupt(signum)

    earlier = set_handlers(stop)
    try:
        yield received
    finally:
        restore_handlers(earlier)


# -- standard output and error ---------------------------------------------------------------------


class Tolerant:
    """A text stream that escapes characters which its encoding doesn't have, and becomes the null
    device after a write error, but that of a closed pipe: no terminal, or a full disk.
    """

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        encoding = getattr(self.stream, "encoding", None) or "utf-8"
        self._try(self.stream.write, text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        self._try(self.stream.flush)

    def _try(self, call: Callable, *arguments: Any) -> None:
        try:
            call(*arguments)
        except BrokenPipeError:
            raise
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())
            # EIO: the terminal is gone, and with it standard error
            if error.errno != errno.EIO and self.stream.fileno() == 1:
                said = f"standard output can't be written ({error.strerror}): going on without it"
                print(said, file=sys.stderr)


@contextlib.contextmanager
def tolerant_output() -> Iterator[None]:
    """Let ``sys.stdout`` and ``sys.stderr`` ignore write errors, also where they are closed."""
    earlier = sys.stdout, sys.stderr
    with open(os.devnull, "w", encoding="utf-8") as null:
        sys.stdout, sys.stderr = (Tolerant(null if s is None else s) for s in earlier)
        try:
            yield
        finally:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
            sys.stdout, sys.stderr = earlier
