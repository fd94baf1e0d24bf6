"""The report of a farm, from the prompt list and the assets' records: a gallery, and a table in CSV
and Parquet. It is written as it is read: the memory doesn't grow with the number of assets."""

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, Optional

from tqdm import tqdm

from ..core.files import atomic_file
from ..view.page import write_static
from .place import FAILED, FINISHED, Place
from .rows import Row

FOLDER, CSV, PARQUET = "report", "table.csv", "table.parquet"
PER_PAGE = 200
"""Assets on one page of the gallery."""
BATCH = 5000
"""Rows of the table that are held in memory."""
COLUMNS = (
    *("name", "prompt", "seed", "state", "seconds", "worker_seconds", "steps", "gaussians"),
    *("megabytes", "bytes", "attempts", "saves_memory", "psnr", "ssim", "multi_face", "cost"),
    *("host", "hash", "picture", "page", "error", "command"),
)
WHOLE = ("seed", "steps", "gaussians", "bytes", "attempts")
NUMBERS = ("seconds", "worker_seconds", "megabytes", "psnr", "ssim", "multi_face", "cost")
"""Columns that are no texts."""


def write_report(
    place: Place, rows: Iterable[Row], total: int, price: Optional[float] = None
) -> tuple[Path, Counter]:
    """Write the report of a farm with ``total`` rows; return its first page and the number of
    assets of each state. ``price`` is that of an hour of one worker.
    """
    folder = place.folder / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    states, seconds, failures, finished, pages = Counter(), 0.0, [], [], []
    with ExitStack() as stack:
        write = tables(stack, folder)
        bar = tqdm(place.records(rows), "report", total, unit="asset", disable=None, delay=1)
        lines = (table_line(row, record, price) for row, record in bar)
        batch: Optional[list] = None
        while batch is None or batch:
            batch = list(islice(lines, BATCH))
            write(batch)
            states.update(line["state"] for line in batch)
            seconds += sum(line["worker_seconds"] or 0.0 for line in batch)
            failures += [line for line in batch if line["state"] == FAILED]
            del failures[1000:]  # the table has all
            finished += [line for line in batch if line["state"] == FINISHED]
            while len(finished) >= PER_PAGE or finished and not batch:
                pages.append(f"page-{len(pages) + 1}.html")
                write_page(folder / pages[-1], assets=finished[:PER_PAGE])
                del finished[:PER_PAGE]
    numbers = {state: f"{states[state]}" for state in sorted(states)}
    numbers["worker time"] = tqdm.format_interval(seconds)
    if price is not None:
        cost = seconds / 3600 * price
        each = f", {cost / states[FINISHED]:.4g} per finished asset" if states[FINISHED] else ""
        numbers["cost"] = f"{cost:.4g}{each}"
    files = [*(name for name in (CSV, PARQUET) if (folder / name).exists()), *pages]
    more = states[FAILED] - len(failures)
    first = folder / "index.html"
    write_page(first, numbers=numbers, files=files, failures=failures, more=more)
    for path in sorted(folder.iterdir()):
        place.upload(f"{FOLDER}/{path.name}")
    return first, states


def write_page(path: Path, *, assets: Sequence = (), **values: Any) -> None:
    title = "Assets, page " + path.stem.removeprefix("page-") if assets else "Report"
    shared = {"numbers": None, "failures": None, "interval": tqdm.format_interval}
    write_static(path, "farm.html", title=title, assets=assets, **shared | values)


def table_line(row: Row, record: dict[str, Any], price: Optional[float]) -> dict[str, Any]:
    """Return a line of the table, with all :data:`COLUMNS`."""
    known = {**record, **(record.get("scores") or {})}
    line = {column: known.get(column) for column in COLUMNS}
    line |= {"name": row.name, "prompt": row.prompt, "seed": row.seed}
    if line["saves_memory"] is not None:
        line["saves_memory"] = "yes" if line["saves_memory"] else "no"
    if price is not None and line["worker_seconds"] is not None:
        line["cost"] = round(line["worker_seconds"] / 3600 * price, 6)
    return line


def tables(stack: ExitStack, folder: Path) -> Callable[[list[dict[str, Any]]], None]:
    """Begin ``table.csv`` and, with pyarrow, ``table.parquet``; return what writes lines."""
    # closed before its file would be
    text = io.TextIOWrapper(stack.enter_context(atomic_file(folder / CSV)), "utf-8", newline="")
    stack.callback(text.detach)
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    try:
        import pyarrow as pa
        from pyarrow.parquet import ParquetWriter
    except ImportError:
        return writer.writerows
    kinds = dict.fromkeys(WHOLE, pa.int64()) | dict.fromkeys(NUMBERS, pa.float64())
    schema = pa.schema([(name, kinds.get(name, pa.string())) for name in COLUMNS])
    file = stack.enter_context(atomic_file(folder / PARQUET))
    parquet = stack.enter_context(ParquetWriter(file, schema))

    def write(lines: list[dict[str, Any]]) -> None:
        writer.writerows(lines)
        parquet.write_table(pa.Table.from_pylist(lines, schema))

    return write
