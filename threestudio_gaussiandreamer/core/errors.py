"""Errors that are the user's to mend: one clear message, exit code 2, a traceback only with
``--verbose``.
"""

import difflib
from collections.abc import Iterable


class UserError(ValueError):
    """Something the user gave can't be used; the message names it, what was expected, and what to
    do.

    Library callers see an ordinary ``ValueError``; the launcher prints the message alone and exits
    with 2."""


class Terminated(SystemExit):
    """A signal asked the process to end; a ``sys.exit()`` in an extension is a mistake instead."""


def unknown(kind: str, name: str, choices: Iterable[str]) -> UserError:
    """The error for a name that isn't among ``choices``: lists the nearest ones, or all when none
    is near.
    """
    choices = sorted(map(str, choices))
    near = difflib.get_close_matches(str(name), choices, n=3, cutoff=0.6)
    hint = (
        f"did you mean {' or '.join(map(repr, near))}?"
        if near
        else f"choose from {', '.join(choices) or 'nothing: none exist'}."
    )
    return UserError(f"unknown {kind} {name!r}: {hint}")
