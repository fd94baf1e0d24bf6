"""Keep a run alive when its standard output or standard error can't be written any more."""

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator
from typing import Any, Optional


class TolerantFile(io.FileIO):
    """A raw file that discards everything after the first write error, for instance when the
    terminal was closed, or when the output is redirected to a disk that is full.

    A closed pipe still raises BrokenPipeError, which ends the command as usual.
    """

    lost = False

    def write(self, data: Any) -> Optional[int]:
        if self.lost:
            return len(data)
        try:
            return super().write(data)
        except BrokenPipeError:
            raise
        except OSError as error:
            self.lost = True
            # EIO: the terminal is gone, and with it standard error
            if error.errno != errno.EIO and self.fileno() == 1:
                print(
                    f"standard output can't be written ({error.strerror}): going on without it",
                    file=sys.stderr,
                )
            return len(data)


@contextlib.contextmanager
def tolerant_output() -> Iterator[None]:
    """Replace ``sys.stdout`` and ``sys.stderr`` by streams that ignore write errors, and that
    escape characters which their encoding doesn't have.

    Streams that Python couldn't open, since their descriptors were closed (``>&-``), are replaced
    by the null device.
    """
    earlier = sys.stdout, sys.stderr
    with contextlib.ExitStack() as opened:
        sys.stdout, sys.stderr = (
            opened.enter_context(open(os.devnull, "w", encoding="utf-8"))
            if stream is None
            else _tolerant(stream)
            for stream in earlier
        )
        try:
            yield
        finally:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
            sys.stdout, sys.stderr = earlier


def _tolerant(stream: Any) -> Any:
    """Reopen a stream's descriptor as a :class:`TolerantFile`; return streams without one as they
    are.
    """
    buffer = getattr(stream, "buffer", None)
    is_unbuffered = isinstance(buffer, io.FileIO)  # python -u, or PYTHONUNBUFFERED
    if not isinstance(buffer if is_unbuffered else getattr(buffer, "raw", None), io.FileIO):
        return stream
    stream.flush()
    file = TolerantFile(buffer.fileno(), "wb", closefd=False)
    return io.TextIOWrapper(
        file if is_unbuffered else io.BufferedWriter(file),
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
