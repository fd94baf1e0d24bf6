"""matplotlib for charts that are written to files."""

from typing import Any


def pyplot() -> Any:
    """Return ``matplotlib.pyplot``, with the backend that needs no display."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt
