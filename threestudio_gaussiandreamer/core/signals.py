"""Signals that stop a run: Ctrl-C, SIGTERM, and SIGHUP, which a closed terminal or a lost SSH
connection sends."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from .errors import Terminated


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
