"""The measured parts of docs/viewing.md, from docs/charts/page.csv and live.csv."""

import statistics

from benchmarks.markdown import markdown, read
from benchmarks.quality.runs import CHARTS


def page_quality() -> str:
    """Return the least dB to our own render over the views, for each target of the blending."""
    rows = [row for row in read(CHARTS / "page.csv") if row["least_db"]]
    targets = list(dict.fromkeys(row["target"] for row in rows))
    cells = {(row["cloud"], row["target"]): row for row in rows}
    table = []
    for cloud in dict.fromkeys(row["cloud"] for row in rows):
        facts = cells[cloud, targets[0]]
        size = [f"{int(facts['gaussians']):,}", facts["page_mb"]]
        table.append((cloud, *size, *(cells[cloud, target]["least_db"] for target in targets)))
    return markdown(("cloud", "Gaussians", "page, MB", *targets), table)


def page_speed() -> str:
    """Return the seconds of writing and opening a page, and of a frame drawn in software."""
    rows = [row for row in read(CHARTS / "page.csv") if row["frame_ms"]]
    table = [
        (
            f"{int(row['gaussians']):,}",
            row["page_mb"],
            row["write_s"],
            row["first_picture_s"],
            f"{float(row['sort_ms']):.0f}",
            f"{float(row['frame_ms']):.0f}",
        )
        for row in rows
    ]
    head = ("Gaussians", "page, MB", "write, s", "first picture, s", "sort, ms", "frame, ms")
    return markdown(head, table)


def live_view() -> str:
    """Return what the live view costs a training, and whether the result is the same."""
    rows = read(CHARTS / "live.csv")
    rounds = {row["round"]: row for row in rows if row["viewer"] == "off"}
    table = []
    for mode in dict.fromkeys(row["viewer"] for row in rows):
        ours = [row for row in rows if row["viewer"] == mode]
        shares = [100 * updates_seconds(row) / float(row["process_s"]) for row in ours]
        more = [
            100 * (float(row["process_s"]) / float(rounds[row["round"]]["process_s"]) - 1)
            for row in ours
        ]
        same = all(row["cloud"] == rounds[row["round"]]["cloud"] for row in ours)
        table.append(
            (
                mode,
                ", ".join(row["updates"] for row in ours),
                cost_of_an_update(ours),
                f"{max(shares):.2f}",
                ", ".join(f"{value:+.1f}" for value in more),
                "yes" if same else "no",
            )
        )
    head = ("viewer", "updates", "CPU ms an update", "largest share of the CPU time, %")
    return markdown((*head, "all CPU time against off, %", "same cloud"), table)


def updates_seconds(row: dict[str, str]) -> float:
    """Return the CPU seconds of updates, in the training's thread and in the server's."""
    return float(row["update_s"]) + float(row["server_s"])


def cost_of_an_update(rows: list[dict[str, str]]) -> str:
    """Return the median over the rounds, milliseconds; nothing if there was none."""
    found = [1000 * updates_seconds(r) / int(r["updates"]) for r in rows if int(r["updates"])]
    return f"{statistics.median(found):.1f}" if found else ""
