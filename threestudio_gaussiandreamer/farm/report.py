"""The report of a farm, from the prompt list and the ledger: a gallery, and a table in CSV and
Parquet.

Everything is written as it is read, so that the memory doesn't grow with the number of assets."""

import csv
import html
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional
from urllib.parse import quote

from ..core.files import atomic_file
from .assets import ASSETS
from .display import duration
from .ledger import FAILED, FINISHED, Ledger
from .rows import Row
from .storage import Place

FOLDER = "report"
PER_PAGE = 200
"""Assets on one page of the gallery."""
MOST_FAILURES = 1000
"""Failures that the first page lists; the table has all."""
BATCH = 5000
"""Rows of the table that are held in memory."""
WAITING = "waiting"
TEXT, WHOLE, NUMBER = "text", "whole number", "number"
COLUMNS = {
    "name": TEXT,
    "prompt": TEXT,
    "seed": WHOLE,
    "state": TEXT,
    "seconds": NUMBER,
    "worker_seconds": NUMBER,
    "steps": WHOLE,
    "gaussians": WHOLE,
    "megabytes": NUMBER,
    "bytes": WHOLE,
    "attempts": WHOLE,
    "saves_memory": TEXT,
    "psnr": NUMBER,
    "ssim": NUMBER,
    "multi_face": NUMBER,
    "cost": NUMBER,
    "host": TEXT,
    "hash": TEXT,
    "picture": TEXT,
    "page": TEXT,
    "error": TEXT,
    "command": TEXT,
}
STYLE = """body{font:15px/1.4 system-ui,sans-serif;margin:2rem;max-width:80rem}
main{display:grid;grid-template-columns:repeat(auto-fill,minmax(180px,1fr));gap:1rem}
figure{margin:0}img{width:100%;background:#eee;aspect-ratio:1;object-fit:cover}
figcaption{overflow-wrap:anywhere}.failed{color:#b00020}code{overflow-wrap:anywhere}
table{border-collapse:collapse}td,th{padding:.2rem .8rem .2rem 0;text-align:left}"""


class Totals:
    """Sums over the rows that pass through :meth:`counted`."""

    def __init__(self) -> None:
        self.states: Counter = Counter()
        self.seconds = self.cost = 0.0
        self.failures: list[dict[str, Any]] = []

    def counted(self, lines: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        for line in lines:
            self.states[line["state"]] += 1
            self.seconds += line["worker_seconds"] or 0.0
            self.cost += line["cost"] or 0.0
            if line["state"] == FAILED and len(self.failures) < MOST_FAILURES:
                self.failures.append(line)
            yield line


class Table(NamedTuple):
    """Paths of the tables that were written."""

    csv: Path
    parquet: Optional[Path]
    """None where pyarrow isn't installed."""


def write_report(
    place: Place, rows: Iterable[Row], ledger: Ledger, price: Optional[float] = None
) -> Path:
    """Write the report of a farm and return its first page.

    Args:
        rows: the prompt list.
        price: of an hour of one worker; None: the table has no cost.
    """
    folder = place.folder / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    totals = Totals()
    pages = Gallery(folder)
    lines = totals.counted(table_lines(rows, ledger, price))
    table = write_table(folder, pages.shown(lines))
    pages.close()
    write_text(folder / "index.html", first_page(totals, table, pages.names, price))
    for path in sorted(folder.iterdir()):
        place.upload(f"{FOLDER}/{path.name}")
    return folder / "index.html"


def table_lines(
    rows: Iterable[Row], ledger: Ledger, price: Optional[float]
) -> Iterator[dict[str, Any]]:
    """Yield a line of the table, with all :data:`COLUMNS`, for each row."""
    for row in rows:
        last = ledger.last(row) or {}
        known = {**last, **(last.get("scores") or {})}
        line = {column: known.get(column) for column in COLUMNS}
        line |= {"name": row.name, "prompt": row.prompt, "seed": row.seed}
        line["state"] = last.get("state", WAITING)
        if line["saves_memory"] is not None:
            line["saves_memory"] = "yes" if line["saves_memory"] else "no"
        # the ledger lacks the last attempt's where the driver was killed
        spent = round(max(ledger.worker_seconds(row), line["seconds"] or 0.0), 3) or None
        line["worker_seconds"] = spent
        if price is not None and spent is not None:
            line["cost"] = round(spent / 3600 * price, 6)
        yield line


# Tables
# --------------------------------------------------------------------------------------------------


def write_table(folder: Path, lines: Iterable[dict[str, Any]]) -> Table:
    """Write ``table.csv``, and ``table.parquet`` where pyarrow is installed."""
    table = Table(folder / "table.csv", folder / "table.parquet")
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        table = table._replace(parquet=None)
    with atomic_file(table.csv) as file:
        content = Utf8Lines(file)
        writer = csv.DictWriter(content, list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        lines = written(writer, lines)
        if table.parquet:
            write_parquet(table.parquet, lines)
        else:
            for _ in lines:
                pass
    return table


class Utf8Lines:
    """The text file that ``csv`` writes to, on a binary one."""

    def __init__(self, file: Any) -> None:
        self.file = file

    def write(self, text: str) -> None:
        self.file.write(text.encode())


def written(writer: Any, lines: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Write each line as it passes."""
    for line in lines:
        writer.writerow(line)
        yield line


def write_parquet(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {TEXT: pa.string(), WHOLE: pa.int64(), NUMBER: pa.float64()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    with atomic_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        for batch in batches(lines, BATCH):
            writer.write_table(pa.Table.from_pylist(batch, schema))


def batches(lines: Iterable[dict[str, Any]], size: int) -> Iterator[list[dict[str, Any]]]:
    batch = []
    for line in lines:
        batch.append(line)
        if len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch


# Pages
# --------------------------------------------------------------------------------------------------


class Gallery:
    """The pages of finished assets, :data:`PER_PAGE` on each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: list[str] = []
        self.figures: list[str] = []

    def shown(self, lines: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        """Add each finished asset as it passes."""
        for line in lines:
            if line["state"] == FINISHED:
                self.figures.append(figure(line))
                if len(self.figures) == PER_PAGE:
                    self.close()
            yield line

    def close(self) -> None:
        """Write the page that isn't full."""
        if self.figures:
            name = f"page-{len(self.names) + 1}.html"
            title = f"Assets, page {len(self.names) + 1}"
            body = f"<main>{''.join(self.figures)}</main>"
            write_text(self.folder / name, page(title, body), durable=False)
            self.names.append(name)
            self.figures = []


def figure(line: dict[str, Any]) -> str:
    """Return the picture of an asset with its prompt and numbers."""
    folder = f"../{ASSETS}/{quote(line['name'])}"
    picture = line["picture"]
    image = f'<img loading="lazy" src="{folder}/{quote(picture)}" alt="">' if picture else ""
    score = f", {line['psnr']:.1f} dB" if line["psnr"] is not None else ""
    numbers = f"{line['gaussians'] or 0} Gaussians, {duration(line['seconds'] or 0)}{score}"
    caption = f"{html.escape(line['prompt'])}<br><small>{numbers}</small>"
    linked = f'<a href="{folder}/{quote(line["page"] or "")}">{image}</a>'
    return f"<figure>{linked}<figcaption>{caption}</figcaption></figure>"


def first_page(totals: Totals, table: Table, pages: list[str], price: Optional[float]) -> str:
    """Return the page with the totals, the failures, and links to tables and gallery."""
    numbers = {state: f"{count}" for state, count in sorted(totals.states.items())}
    numbers["worker time"] = duration(totals.seconds)
    if price is not None:
        made = totals.states[FINISHED]
        each = f", {totals.cost / made:.4g} per finished asset" if made else ""
        numbers["cost"] = f"{totals.cost:.4g}{each}"
    cells = "".join(f"<tr><th>{name}</th><td>{text}</td></tr>" for name, text in numbers.items())
    files = [path.name for path in table if path is not None]
    links = " ".join(f'<a href="{name}">{name}</a>' for name in [*files, *pages])
    failures = "".join(failure(line) for line in totals.failures)
    more = totals.states[FAILED] - len(totals.failures)
    left_out = f"<p>{more} more are in {table.csv.name}.</p>" if more else ""
    heading = "<h2>Failures</h2>" if failures else ""
    body = f"<table>{cells}</table><p>{links}</p>{heading}{failures}{left_out}"
    return page("Report", body)


def failure(line: dict[str, Any]) -> str:
    """Return a failed asset, its error, and the command that repeats it."""
    error, command = html.escape(str(line["error"])), html.escape(str(line["command"]))
    name, prompt = html.escape(line["name"]), html.escape(line["prompt"])
    return (
        f'<p><b>{name}</b>: {prompt}<br><span class="failed">{error}</span><br>'
        f"<code>{command}</code></p>"
    )


def page(title: str, body: str) -> str:
    return (
        f'<!doctype html><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style><h1>{title}</h1>{body}\n"
    )


def write_text(path: str | os.PathLike, text: str, *, durable: bool = True) -> None:
    with atomic_file(path, durable=durable) as file:
        file.write(text.encode())
