"""Errors of a stage that a user can correct: converted to one message."""

import contextlib
import errno
import re
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError, raised_in
from ..host import pl, warn
from .ddp import is_lost_process

# errors of the file system that end a run with a message instead of a traceback
WRITE_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM),
    *(errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG),
)
# parts of the messages of torch and Lightning about a state that doesn't match
MISMATCHES = (
    *("loading state_dict", "loaded state dict"),
    *("optimizer_states", "restore training state"),
)


@contextlib.contextmanager
def lightning_errors(checkpoint: Optional[str], changes: Sequence[str] = ()) -> Iterator[None]:
    """Convert exceptions that Lightning raises in this context.

    Args:
        changes: what may explain a mismatch, in place of torch's message.

    Raises:
        UserError: the checkpoint's parameters or optimiser don't match the configuration, or the
            trainer's options are incompatible with the system or with each other, or another
            process of the run has ended.
        KeyboardInterrupt: Ctrl-C outside of training, which Lightning converts to SystemExit(1).
    """
    try:
        yield
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise
    except pl.utilities.exceptions.MisconfigurationException as error:
        raise UserError(f"trainer: {error}") from error
    except (RuntimeError, ValueError, KeyError) as error:
        if is_lost_process(error):
            raise UserError(
                "another process of this run has ended, so this one stops; the same command with "
                f"resume=auto goes on from the last checkpoint ({str(error).strip()})"
            ) from error
        if isinstance(error, ValueError) and raised_in(error, pl.__name__):
            raise UserError(f"trainer: {str(error).strip()}") from error
        of_state = any(part in str(error) for part in MISMATCHES) or raised_in(error, pl.__name__)
        if checkpoint is None or isinstance(error, UserError) or not of_state:
            raise
        raise UserError(
            f"the checkpoint {checkpoint} was made by another configuration: "
            f"{'; '.join(changes) or _differences(str(error))}"
        ) from error


def _differences(message: str) -> str:
    """Return torch's message about a state that doesn't match in one line: the names of parameters
    that only the configuration or only the checkpoint has, else its words.
    """
    said = {"Missing": "it has no {}", "Unexpected": "its {} is in no part of this run"}
    names = [
        text.format(found[1].replace('"', ""))
        for kind, text in said.items()
        if (found := re.search(rf"{kind} key\(s\).*?: (.+?)\.\s*$", message, re.MULTILINE))
    ]
    return ", ".join(names) or " ".join(message.split())


@contextlib.contextmanager
def write_errors(folder: Path) -> Iterator[None]:
    """Convert OSErrors of this context, and of the loggers' threads, to one message.

    Args:
        folder: of the run's results, for messages.

    Raises:
        UserError: the disk is full, access is denied, a path exists as something else, or another
            process has removed a file in the folder.
    """

    def said(error: OSError) -> str:
        return (
            f"cannot write {error.filename or f'the results in {folder}'}: "
            f"{error.strerror}; make room, or choose another exp_root_dir"
        )

    def in_a_thread(failure: Any) -> None:
        # only a warning, since the logger raises the error again when it next writes
        warn(said(failure.exc_value)) if _is_write_error(failure.exc_value) else earlier(failure)

    earlier, threading.excepthook = threading.excepthook, in_a_thread
    try:
        yield
    except FileNotFoundError as error:
        if folder.absolute() not in Path(str(error.filename or "/")).absolute().parents:
            raise
        raise UserError(
            f"{error.filename} has been removed or replaced while it was needed: another command "
            f"works in {folder}; run this one again when that has ended"
        ) from error
    except OSError as error:
        if not _is_write_error(error):
            raise
        raise UserError(said(error)) from error
    finally:
        threading.excepthook = earlier


def _is_write_error(error: Optional[BaseException]) -> bool:
    return isinstance(error, OSError) and error.errno in WRITE_ERRORS
