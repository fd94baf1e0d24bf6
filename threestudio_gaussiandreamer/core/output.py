"""Standard output and error of a run: no failure to show a message ends the work."""

import contextlib
import errno
import io
import sys
from collections.abc import Iterator
from typing import Any, Optional


class TolerantFile(io.FileIO):
    """A file descriptor that goes on accepting text after writing has failed once: the terminal was
    closed, or the disk of a redirected output is full.

    A closed pipe still raises BrokenPipeError, since its reader wants no more.
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
            # after a hang-up the other stream is gone too
            if error.errno != errno.EIO and self.fileno() == 1:
                print(
                    f"standard output can't be written ({error.strerror}): going on without it",
                    file=sys.stderr,
                )
            return len(data)


@contextlib.contextmanager
def tolerant_output() -> Iterator[None]:
    """Let ``sys.stdout`` and ``sys.stderr`` tolerate failures, and characters that their encoding
    doesn't have, which are written as escapes.
    """
    earlier = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(_tolerant, earlier)
    try:
        yield
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        sys.stdout, sys.stderr = earlier


def _tolerant(stream: Any) -> Any:
    """Open a stream's file as a :class:`TolerantFile`; a stream of another kind is returned."""
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
