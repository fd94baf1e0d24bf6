"""The measured parts of pages in reports/exports.md and speed.md, from docs/charts/page.csv."""

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
