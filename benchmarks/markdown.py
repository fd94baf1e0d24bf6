"""CSV files of results, and their Markdown tables."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from threestudio_gaussiandreamer.core.files import write_file


def read(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV; lines that begin with # are comments.

    Raises:
        ValueError: a row has more or fewer fields than the header.
    """
    with open(path, newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    for row in rows:
        if None in row or None in row.values():
            raise ValueError(f"{path}: a row has another number of fields than the header: {row}")
    return rows


def write(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as a CSV; the file that is there stays until all of them are made."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file(path, text.getvalue())


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write rows of values in the order of the columns, as :func:`write` does."""
    write(path, columns, (dict(zip(columns, row, strict=True)) for row in rows))


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])
