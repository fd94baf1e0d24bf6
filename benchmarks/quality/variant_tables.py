"""The measured part of docs/distillation.md."""

from benchmarks.markdown import markdown, read
from benchmarks.quality.tables import RESULTS


def overhead() -> str:
    """Return the CPU time of each variant beside its calls of the score model."""
    rows = read(RESULTS / "variant_overhead.csv")
    setting = "{gaussians} Gaussians, {views} views of {size}², an empty score model, {machine}"
    columns = ("variant", "evaluations", "extra_ms", "percent")
    heads = ("variant", "calls per view", "ms more than SDS", "% of a step")
    table = markdown(heads, ([row[column] for column in columns] for row in rows))
    return f"{setting.format(**rows[0])}:\n\n{table}"
