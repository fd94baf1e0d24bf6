"""What every command of the package does around its work: exit codes, and one message for what the
user can mend."""

import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any, Optional

from .errors import UserError
from .output import tolerant_output


def run_command(
    parse: Callable[[Optional[Sequence[str]]], Any],
    run: Callable[[Any], Any],
    argv: Optional[Sequence[str]] = None,
) -> int:
    """Parse a command line and run it.

    Args:
        parse: from the arguments (None: this process's) to what ``run`` takes.
        run: does the work.

    Returns:
        the exit code: 0 done; 2 a mistake of the user; 130 Ctrl-C; 141 a closed pipe.
    """
    try:
        args = parse(argv)
    except SystemExit as stop:  # --help, or a mistake that argparse has printed
        return int(stop.code or 0)
    with tolerant_output():
        try:
            run(args)
            sys.stdout.flush()
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            return 128 + signal.SIGINT
        except Exception as error:
            return exit_code(error)
    return 0


def exit_code(error: Exception, verbose: bool = False) -> int:
    """Say what ended a command, in one message.

    Raises:
        Exception: ``error`` itself, if it is a mistake of the program.
    """
    if not isinstance(error, (UserError, BrokenPipeError)):
        raise error
    if verbose:
        traceback.print_exc()
    if isinstance(error, UserError):
        print(f"error: {error}", file=sys.stderr)
        return 2
    # the reader of the output has gone, as in `| head`; without this, flushing would fail at exit
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    print(f"stopped: the reader of the output has closed it ({error.strerror})", file=sys.stderr)
    return 128 + signal.SIGPIPE
