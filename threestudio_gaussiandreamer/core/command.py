"""Run a command-line program: exit codes, and errors in the user's input as one message without a
traceback."""

import contextlib
import errno
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Optional

from .errors import Terminated, UserError
from .extras import error_of_extra
from .launcher import require_numbers
from .signals import raised_signals


def run_command(
    parse: Callable[[Optional[Sequence[str]]], Any],
    run: Callable[[Any], Any],
    argv: Optional[Sequence[str]] = None,
) -> int:
    """Parse a command line and run it.

    Args:
        parse: parses the arguments; None means those of this process.
        run: does the work; its argument is what ``parse`` returned. It may return an exit code.

    Returns:
        the exit code: 0 for success, 2 for wrong input, 141 for a closed pipe, 128 and the number
        of a stop signal, even if other code has caught or replaced the exception that it raised.
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
        except KeyboardInterrupt:  # also raised by handlers that a caller has installed
            received = received or [signal.SIGINT]
        except Exception as error:
            if not received:
                return exit_code(error, getattr(args, "verbose", False))
        except SystemExit as stop:
            if isinstance(stop, Terminated):
                received = received or [stop.code - 128]
            if not received:
                return exit_code(foreign_exit(stop), getattr(args, "verbose", False))
        print("stopped", file=sys.stderr)
    return 128 + received[0]


def foreign_exit(stop: SystemExit) -> UserError:
    """Make the error for a ``sys.exit()`` in a library or extension, whose code may be 0."""
    *_, place = traceback.extract_tb(stop.__traceback__)
    return UserError(f"{place.filename}:{place.lineno} ended the run with sys.exit({stop.code!r})")


def joined_values(
    argv: Optional[Sequence[str]], options: Sequence[str], values: Collection[str]
) -> list[str]:
    """Join each of these options to the value behind it by ``=``, where argparse would take a value
    that begins with a hyphen for an option.

    Args:
        argv: None means the arguments of this process.
    """
    joined: list[str] = []
    for word in sys.argv[1:] if argv is None else argv:
        # a wrong "-z" too, so that it is a wrong value and no missing one
        if joined and joined[-1] in options and {word, word.lstrip("-")} & {*values}:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def run_main(module: str) -> int:
    """Import a module, which may take seconds, and return the exit code of its ``main()``.

    A stop signal during the import ends the process with one line and the signal's exit code.
    """
    received: Sequence[int] = ()
    try:
        with raised_signals() as received:
            require_numbers()
            main = importlib.import_module(module).main
    except UserError as error:
        return exit_code(error)
    except BaseException:
        if not received:
            raise
    if received:  # also if the import has caught the exception
        with tolerant_output():
            print("stopped", file=sys.stderr)
        return 128 + received[0]
    return main()


def exit_code(error: Exception, verbose: bool = False) -> int:
    """Print one message about the error that ended a command, and return the exit code.

    Raises:
        Exception: ``error`` itself, unless it is a UserError, a BrokenPipeError, or about a missing
            module of an extra.
    """
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
    with contextlib.suppress(BrokenPipeError):  # after `2>&1 |` it has no reader either
        print(
            f"stopped: the reader of the output has closed it ({error.strerror})", file=sys.stderr
        )
    return 128 + 13  # SIGPIPE, which Windows doesn't have


class Tolerant:
    """A text stream that escapes characters which its encoding doesn't have, and whose descriptor
    becomes the null device after the first write error, for instance when the terminal was closed,
    or when the output is redirected to a disk that is full.

    A closed pipe still raises BrokenPipeError, which ends the command as usual.
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
                print(
                    f"standard output can't be written ({error.strerror}): going on without it",
                    file=sys.stderr,
                )


@contextlib.contextmanager
def tolerant_output() -> Iterator[None]:
    """Let ``sys.stdout`` and ``sys.stderr`` ignore write errors. Streams that Python couldn't open,
    since their descriptors were closed (``>&-``), are replaced by the null device.
    """
    earlier = sys.stdout, sys.stderr
    with open(os.devnull, "w", encoding="utf-8") as null:
        sys.stdout, sys.stderr = (Tolerant(null if s is None else s) for s in earlier)
        try:
            yield
        finally:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
            sys.stdout, sys.stderr = earlier
