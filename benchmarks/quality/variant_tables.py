"""The measured parts of docs/distillation.md."""

from benchmarks.markdown import markdown, read
from benchmarks.quality.chart_runs import ends, grouped, median
from benchmarks.quality.runs import rows_of
from benchmarks.quality.tables import RESULTS
from benchmarks.quality.variants import CHART, at_best

SCORES = ("psnr", "evaluations", "cpu_seconds", "out_of_gamut", "saturation")


def overhead() -> str:
    """Return the CPU time of each variant beside its calls of the score model."""
    rows = read(RESULTS / "variant_overhead.csv")
    setting = "{gaussians} Gaussians, {views} views of {size}², an empty score model, {machine}"
    columns = ("variant", "evaluations", "extra_ms", "percent")
    heads = ("variant", "calls per view", "ms more than SDS", "% of a step")
    table = markdown(heads, ([row[column] for column in columns] for row in rows))
    return f"{setting.format(**rows[0])}:\n\n{table}"


def quality() -> str:
    """Return the scores of each line of ``variants.csv`` at its best guidance scale, best first."""
    found = [
        (label, *(median(ends(own), column) for column in SCORES))
        for label, own in grouped(at_best(rows_of(CHART)), lambda row: row["variant"]).items()
    ]
    rows = rows_of(CHART)
    seeds, scales = (sorted({float(row[name]) for row in rows}) for name in ("seed", "x"))
    tried = ", ".join(f"{scale:g}" for scale in scales)
    head = f"{len(seeds)} seed{'s' * (len(seeds) > 1)}, scales tried: {tried}."
    titles = ("variant, scale", "dB", "evaluations", "CPU seconds", "out of gamut", "saturation")
    cells = [
        (label, f"{db:.1f}", f"{asked:,.0f}", f"{seconds:.0f}", f"{100 * out:.1f} %", f"{sat:.2f}")
        for label, db, asked, seconds, out, sat in sorted(found, key=lambda line: -line[1])
    ]
    return f"{head}\n\n{markdown(titles, cells)}"
