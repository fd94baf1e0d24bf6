"""The memory that a block of a test may take."""

import contextlib
import tracemalloc
from collections.abc import Iterator


@contextlib.contextmanager
def memory_below(most: float, least: float = 0) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert least <= tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
