"""Write the tables of README.md and docs/ from the committed CSVs: ``python -m benchmarks.tables``.

docs/results.md is written whole; in other pages the text between ``<!-- name -->`` and
``<!-- end -->`` is replaced. ``tests/test_docs.py`` fails when a page is stale.
"""

import csv
import re
from collections.abc import Callable
from pathlib import Path

from benchmarks.quality import tables as quality
from benchmarks.quality.runs import CHARTS, ROOT
from benchmarks.quality.tables import (
    DIFFERENCES,
    difference_row,
    last_rows,
    markdown,
    medians,
    named,
)

RESULTS = ROOT / "benchmarks/results"
SCENES = ("initial", "trained", "fog", "needles", "deep", "near plane")
PRESETS = {"fast": "1/255", "balanced": "1/1024", "accurate": "1/65536"}
CONTENDERS = {
    "cpu": "CPU kernel",
    "cpu-v3": "the same, built for AVX2",
    "torch": "plain torch",
    "gsplat": "gsplat's plain torch",
    "prototype": "AVX-512 prototype (intrinsics)",
}


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV; lines that begin with # are comments."""
    with open(path, newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


# ---- README.md -----------------------------------------------------------------------------------


def decibels(chart: str, variant: str) -> str:
    """Median dB of a variant on the three objects."""
    rows = [
        row for place, same in last_rows(chart).items() if variant in named(place) for row in same
    ]
    return medians(rows, "psnr", 1, 1)


def gain(title: str) -> str:
    """Median difference on the three objects, with signs."""
    (found,) = (row for row in map(difference_row, DIFFERENCES) if row[0] == title)
    return " / ".join(f"{float(cell.split()[0]):+.1f}" for cell in found[1:4])


def speedup() -> str:
    """How many times faster our CPU kernel is than gsplat's plain torch, for each thread count."""
    rows = read(RESULTS / "splatting.csv")
    ms = {
        (row["threads"], row["contender"]): float(row["both_ms"])
        for row in rows
        if (row["gaussians"], row["size"]) == ("100000", "512")
    }
    threads = sorted({key[0] for key in ms}, key=int)
    return " / ".join(f"{ms[n, 'gsplat'] / ms[n, 'cpu']:.0f}" for n in threads)


def fuzzed() -> tuple[int, int]:
    """Damaged files tried, and failures of any target."""
    rows = read(RESULTS / "fuzz.csv")
    files = sum(int(row["inputs"]) for row in rows if row["unit"] == "damaged files")
    return files, sum(int(row["failures"]) for row in rows)


def readme_table() -> str:
    """The table of README.md: dB and differences for toy / spot / duck."""
    files, failures = fuzzed()
    few = "1,500 Gaussians − all 10,000 of the paper's recipe"
    rows = (
        ("the demo, held-out dB (5,000 Gaussians)", decibels("quality", "default")),
        ("`demo-draft.yaml` / `demo-best.yaml`",
         f"{decibels('quality', 'draft')}; {decibels('quality', 'best')}"),
        ("15 % of the paper's Gaussians against all of them, dB", gain(few)),
        ("1,500 Gaussians, pruned in the loop against from scratch, dB",
         gain("1,500, pruned in the loop − 1,500 from scratch")),
        ("view-blind score: prior against random start, dB",
         gain("view-blind, prior − random start")),
        ("CPU kernel against gsplat's plain torch, 100,000 Gaussians at 512², 1 / 4 threads",
         f"{speedup()} times faster"),
        ("damaged files tried, failures", f"{files:,}, {failures}"),
    )  # fmt: skip
    return markdown(("median over the seeds", "toy / spot / duck"), rows)


# ---- docs/rasteriser.md --------------------------------------------------------------------------


def presets() -> str:
    """PSNR of each preset on each scene at 512²; gradient error and time on a trained cloud."""
    rows = [row for row in read(CHARTS / "rasteriser.csv") if row["size"] == "512"]
    cells = {(row["setting"], row["scene"]): row for row in rows if row["setting"] in PRESETS}
    table = []
    for preset, cut in PRESETS.items():
        trained, fastest = cells[preset, "trained"], cells["fast", "trained"]
        psnr = (f"{float(cells[preset, scene]['psnr']):.1f}" for scene in SCENES)
        ratio = milliseconds(trained) / milliseconds(fastest)
        table.append((f"`{preset}`", cut, *psnr, f"{float(trained['l2']):.1%}", f"{ratio:.1f}"))
    head = ("preset", "smallest alpha", *SCENES, "worst gradient, trained", "time, trained")
    return markdown(head, table)


def milliseconds(row: dict[str, str]) -> float:
    return float(row["forward_ms"]) + float(row["backward_ms"])


def contenders() -> str:
    """Milliseconds of forward and backward for 100,000 Gaussians, and memory at 1024²."""
    rows = {
        (row["contender"], row["size"], row["threads"]): row
        for row in read(RESULTS / "splatting.csv")
        if row["gaussians"] == "100000"
    }
    threads = sorted({key[2] for key in rows}, key=int)
    places = [(size, count) for size in ("512", "1024") for count in threads]
    table = []
    for contender, title in CONTENDERS.items():
        found = [rows.get((contender, *place)) for place in places]
        cells = [f"{float(row['both_ms']):.1f}" if row else "" for row in found]
        memory = [float(row["memory_mb"]) for row in found if row]
        table.append((title, *cells, f"{max(memory):.0f} MB"))
    head = [f"{size}², {count} thread{'s' * (count != '1')}" for size, count in places]
    return markdown(("", *head, "largest memory"), table)


# ---- docs/robustness.md --------------------------------------------------------------------------


def fuzz() -> str:
    """Inputs, failures, refusals and seconds of each target."""
    columns = ("target", "unit", "inputs", "failures", "refused", "seconds")
    rows = read(RESULTS / "fuzz.csv")
    return markdown(columns, ([row[column] for column in columns] for row in rows))


# ---- pages ---------------------------------------------------------------------------------------

SECTIONS: dict[str, dict[str, Callable[[], str]]] = {
    "README.md": {"measured": readme_table},
    "docs/rasteriser.md": {"presets": presets, "contenders": contenders},
    "docs/robustness.md": {"fuzz": fuzz},
}


def filled(text: str, sections: dict[str, Callable[[], str]]) -> str:
    """A page with its generated sections made from the CSVs of today."""
    for name, table in sections.items():
        place = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        made = table()
        text, count = place.subn(lambda match, made=made: f"{match[1]}{made}{match[2]}", text)
        assert count == 1, f"<!-- {name} --> stands {count} times"
    return text


def pages() -> dict[Path, str]:
    """Every page with generated tables, to its text."""
    made = {ROOT / name: filled((ROOT / name).read_text(), s) for name, s in SECTIONS.items()}
    return made | {ROOT / "docs/results.md": quality.page()}


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
        print(path.relative_to(ROOT))
