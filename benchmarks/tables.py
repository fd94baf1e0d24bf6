"""Write the tables of README.md, docs/ and reports/ from the committed CSVs.

Run as ``python -m benchmarks.tables``. reports/results.md and reports/stability.md are written
whole; in other pages the text between ``<!-- name -->`` and ``<!-- end -->`` is replaced.
``tests/test_docs.py`` fails when a page is stale.
"""

import re
from collections.abc import Callable

from benchmarks.markdown import markdown
from benchmarks.quality import avatars, formats, large_prune
from benchmarks.quality import mesh as mesh_quality
from benchmarks.quality import tables as quality
from benchmarks.quality import toybox_tables as toybox
from benchmarks.quality.runs import ROOT
from benchmarks.quality.tables import DIFFERENCES, difference_row, last_rows, medians, named
from benchmarks.robustness import tables as robustness
from benchmarks.splatting import tables as splatting
from benchmarks.start import tables as start
from benchmarks.viewers import tables as viewers
from tests.stability import report as stability

# ---- README.md -----------------------------------------------------------------------------------


def median_of(chart: str, variant: str, column: str = "psnr", digits: int = 1) -> str:
    """Return the median of a column over a variant's runs, for each of the three objects."""
    rows = [
        row for place, same in last_rows(chart).items() if variant in named(place) for row in same
    ]
    return medians(rows, column, 1, digits)


def gain(title: str) -> str:
    """Return the median difference on the three objects, with signs."""
    (found,) = (row for row in map(difference_row, DIFFERENCES) if row[0] == title)
    return " / ".join(f"{float(cell.split()[0]):+.1f}" for cell in found[1:4])


def readme_table() -> str:
    """Return the table of README.md: dB, differences and seconds for toy / spot / duck."""
    few = "1,500 Gaussians − all 10,000 of the paper's recipe"
    rows = (
        ("the demo, held-out dB", median_of("quality", "default")),
        ("the demo, CPU seconds of one thread",
         median_of("quality", "default", "cpu_seconds", digits=0)),
        ("`demo-draft.yaml` / `demo-best.yaml`, dB",
         f"{median_of('quality', 'draft')}; {median_of('quality', 'best')}"),
        ("15 % of the paper's Gaussians − all of them, dB", gain(few)),
        ("1,500 Gaussians, pruned in the loop − from scratch, dB",
         gain("1,500, pruned in the loop − 1,500 from scratch")),
        ("view-blind score, prior − random start, dB", gain("view-blind, prior − random start")),
        ("CPU kernel against gsplat's plain torch, 100,000 Gaussians at 512²",
         splatting.speedup()),
        ("damaged files tried, failures", robustness.damaged_files()),
        ("text to 3D with the bundled models, % of withheld prompts with the right "
         "kind / colours / pattern / accessory", toybox.summary()),
    )  # fmt: skip
    return markdown(("median over the seeds", "toy / spot / duck"), rows)


# ---- pages ---------------------------------------------------------------------------------------

SECTIONS: dict[str, dict[str, Callable[[], str]]] = {
    "README.md": {"measured": readme_table},
    "docs/formats.md": {"formats": formats.table, "producers": formats.producers},
    "docs/pruning.md": {"large prune": large_prune.table},
    "docs/rasteriser.md": {"presets": splatting.presets},
    "docs/toybox.md": {"models": toybox.card},
    "reports/exports.md": {"front": mesh_quality.front, "quality": viewers.page_quality},
    "reports/robustness.md": {"fuzz": robustness.fuzz, "long run": robustness.long_run},
    "reports/small_models.md": {
        "avatars": avatars.table,
        "toybox": toybox.results,
        "seeds": toybox.seeds,
    },
    "reports/speed.md": {
        "thresholds": splatting.thresholds,
        "contenders": splatting.contenders,
        "gpu": splatting.gpu,
        "start": start.first_step,
        "speed": viewers.page_speed,
    },
}


def filled(text: str, sections: dict[str, Callable[[], str]]) -> str:
    """Return a page with its generated sections made from the current CSVs."""
    for name, table in sections.items():
        place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        made = table()
        text, count = place.subn(lambda match, made=made: f"{match[1]}{made}\n{match[2]}", text)
        assert count == 1, f"<!-- {name} --> occurs {count} times"
    return text


WHOLE = {"reports/results.md": quality.page, "reports/stability.md": stability.page}
PAGES = (*SECTIONS, *WHOLE)
"""The pages with generated parts."""


def text_of(page: str) -> str:
    """Return the text of one of PAGES."""
    if page in WHOLE:
        return WHOLE[page]()
    return filled((ROOT / page).read_text(), SECTIONS[page])


if __name__ == "__main__":
    for name in PAGES:
        (ROOT / name).write_text(text_of(name))
        print(name)
