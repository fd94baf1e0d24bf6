"""Errors in the user's input."""

import difflib
import traceback
from collections.abc import Iterable


class UserError(ValueError):
    """Invalid input; the message names it, what was expected, and what to do."""


class Terminated(SystemExit):
    """Raised when a signal ends the process; a ``sys.exit()`` in an extension is an error."""


def unknown(kind: str, name: str, choices: Iterable[str], prefix: str = "") -> UserError:
    """Make the error for a name that isn't among ``choices``; its message lists similar choices, or
    all, and puts ``prefix``, such as a section, in front of the names.
    """
    choices = sorted(set(map(str, choices)))
    near = difflib.get_close_matches(str(name), choices, n=3, cutoff=0.6)
    if near:
        hint = f"did you mean {' or '.join(repr(prefix + choice) for choice in near)}?"
    else:
        hint = f"choose from {', '.join(choices)}." if choices else "there are none."
    return UserError(f"unknown {kind} {prefix + str(name)!r}: {hint}")


def raised_in(error: BaseException, package: str) -> bool:
    """Return whether code of a package raised an error itself, rather than code that it called."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return frame.f_globals.get("__name__", "").startswith(package)
