"""Tables of variants of toybox.yaml, each compared with toybox.yaml itself on the same prompts and
seeds: the paired tables of docs/toybox.md and docs/distillation.md, from docs/charts/toybox.csv and
toybox_gpu.csv, and ratios of seconds from benchmarks/results/toybox.csv.

``recognised`` is the share of the attributes that a prompt asks for (kind, colours, pattern,
accessory) that the judge finds in the result. A dagger marks comparisons of which both sides were
measured with earlier models or an earlier toybox.yaml, or scored by an earlier judge.
"""

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from benchmarks.markdown import markdown
from benchmarks.quality import toybox_jobs, toybox_options
from benchmarks.quality.chart_runs import grouped
from benchmarks.quality.runs import rows_of
from benchmarks.quality.tables import RESULTS
from benchmarks.quality.toybox_tables import (
    NOT_MEASURED,
    Row,
    asks_for,
    is_present,
    measured,
    median_of,
    title_of,
)
from threestudio_gaussiandreamer.evaluation.intervals import paired, per_prompt

HEAD = ("variant", "prompts × seeds", "recognised, %", "− toybox.yaml")
HEAD += ("multi-face, %", "− toybox.yaml", "haze, %", "of toybox.yaml")
WRONG_PRIOR = toybox_jobs.WRONG_PRIOR
SECONDS = ("CPU seconds", "of toybox.yaml")
DISTILLATIONS = ("paper", "distillations", "fixed_timesteps", "cheaper", "feature_reuse")
"""Charts that docs/distillation.md shows; docs/toybox.md shows the others."""
SETTINGS = [
    name
    for name in toybox_options.CHARTS
    if name not in (*DISTILLATIONS, "references", "default", "looks")
]
ABLATIONS = ("growing", "counts", "prior_quality")
"""Charts of the paper's ablations."""
PAPER_TITLES = {f"{name.upper()} {x:g}" for name, x in toybox_options.PAPER_SCALES.items()}
"""Lines at the guidance scale of their paper."""
DISTILLED = "toybox_distilled"
"""Runs of toybox.py with a U-Net that takes the scale as an input."""
DIVERSITY = "toybox_diversity"
"""Written by toybox_diversity.py."""
ENOUGH = 8
"""Rows of the present state of which those of earlier ones say nothing more."""
EARLIER = {
    "98917812": "before view contrast",
    "c9adfc93": "networks in float32",
    "91562c50": "U-Net before 184,000 further pictures",
    "943e902e": "U-Net before the training on joined views",
    "6075424d": "300 steps",
    "7ac24043": "models before the words for left and right",
    "2d37b05f": "models of the objects of version 1",
}
"""Earlier states of models and configuration, by the column ``setup``; the newest first."""


def distillations() -> str:
    """Return the table of score distillations and of cheaper steps with the learned models, from
    runs on a GPU and on CPUs, with the ratio of their seconds to those of toybox.yaml in runs that
    were made for that.
    """
    ratios = {title: f"{ratio:.1f}" for title, ratio in seconds_of_variants().items()}
    found = [*lines_beside_cpus(all_runs(), DISTILLATIONS), *distilled()]
    lines = [(paper_marked(title), *cells, ratios.get(title, "")) for title, *cells in found]
    return markdown((*HEAD, "seconds / toybox.yaml's"), lines) if lines else NOT_MEASURED


def distilled() -> list[tuple[str, ...]]:
    """Return the line of toybox.yaml with the U-Net that guidance was distilled into; none
    if it wasn't measured.
    """
    default = [row for row in all_runs() if row["variant"] == toybox_jobs.DEFAULT]
    plain = {(row["index"], row["seed"]): row for row in default if is_present(row)}
    rows = rows_of(DISTILLED, RESULTS)
    own = [row for row in rows if (row["index"], row["seed"]) in plain]
    same = [plain[row["index"], row["seed"]] for row in own]
    return [line_of("guidance in one evaluation", own, same)] if own else []


def paper_marked(title: str) -> str:
    """Return a line's title with a mark if its guidance scale is that of its paper."""
    return f"{title} (its paper's)" if title in PAPER_TITLES else title


def settings_on_gpu() -> str:
    """Return the table of all settings but the distillation's of which there are runs on a GPU.
    Those that it lacks are taken from CPUs.
    """
    lines = lines_beside_cpus(gpu_rows(), SETTINGS)
    return markdown(HEAD, lines) if lines else NOT_MEASURED


def lines_beside_cpus(rows: Sequence[Row], charts: Iterable[str]) -> list[tuple[str, ...]]:
    """Return a line for each variant of these charts; where there are runs of toybox.yaml on a GPU,
    the first line is those on CPUs compared with them.
    """
    on_gpu = measured(toybox_jobs.GPU_CHART)
    default = [row for row in on_gpu if row["variant"] == toybox_jobs.DEFAULT and is_present(row)]
    on_cpus = {place(row): row for row in measured() if row["variant"] == toybox_jobs.DEFAULT}
    both = [row for row in default if place(row) in on_cpus]
    same = [on_cpus[place(row)] for row in both]
    lines = [line_of(f"{toybox_jobs.DEFAULT} on CPUs", same, both)] if both else []
    pairs = pairs_of_charts(rows, charts)
    return lines + [line_of(marked_title(own[0]), own, plain) for own, plain in pairs]


def wrong_priors() -> str:
    """Return the table of parts of growing, numbers of Gaussians and small timesteps with a prior
    of another kind, each compared with the same prior alone, from runs on a GPU and on CPUs.
    """
    rows = all_runs()
    parts = [one.key for one in toybox_options.wrong_priors() if one.wrong_prior]
    pairs = [pair for key in parts for pair in pairs_of(rows, *key, base=WRONG_PRIOR)]
    lines = [line_of(marked_title(own[0]), own, whole) for own, whole in pairs]
    head = [title.replace(toybox_jobs.DEFAULT, WRONG_PRIOR) for title in HEAD]
    return markdown(head, lines) if lines else NOT_MEASURED


def ablations() -> str:
    """Return the table of parts of Algorithm 1, numbers of Gaussians and qualities of the prior,
    with the learned prior and with one of another kind, from runs on a GPU and on CPUs.
    """
    rows = [row for row in all_runs() if is_present(row)]
    parts = [("all of it", (toybox_jobs.DEFAULT, "0"), (WRONG_PRIOR, "0"))]
    for name, x in (one.key for chart in ABLATIONS for one in toybox_options.CHARTS[chart]()):
        title = name if x == "0" else f"{name} {x}"
        parts.append((title, (name, x), (f"{WRONG_PRIOR}, {name}", x)))
    lines = [
        (title, *cells)
        for title, learned, wrong in parts
        if any(cells := (*part_of(rows, learned), *part_of(rows, wrong, WRONG_PRIOR)))
    ]
    columns = ("prompts × seeds", "recognised, %", "− all of it", "multi-face, %")
    head = [f"{prior}: {column}" for prior in ("learned prior", WRONG_PRIOR) for column in columns]
    return markdown(("part", *head), lines) if lines else NOT_MEASURED


def part_of(
    rows: Sequence[Row], key: tuple[str, str], base: str = toybox_jobs.DEFAULT
) -> tuple[str, ...]:
    """Return the cells of a variant, compared with ``base``; empty ones if it wasn't measured."""
    for own, plain in pairs_of(rows, *key, base=base):
        _, counts, recognised, change, faces, *_ = line_of("", own, plain)
        return counts, recognised, "" if key[0] == base else change, faces
    return ("",) * 4


def gpu_rows() -> list[Row]:
    """Return the rows of runs on a GPU, and those on CPUs that it lacks of the same variants."""
    variants = {title_of(row) for row in measured(toybox_jobs.GPU_CHART)}
    return [row for row in all_runs() if title_of(row) in variants]


def all_runs() -> list[Row]:
    """Return the rows of runs on a GPU, and those on CPUs that it lacks."""
    rows = measured(toybox_jobs.GPU_CHART)
    return [*rows, *lacking(rows, measured())]


def lacking(rows: Sequence[Row], others: Sequence[Row]) -> list[Row]:
    """Return those of ``others`` whose variant, prompt and seed aren't in ``rows``."""
    done = {(title_of(row), place(row)) for row in rows}
    return [row for row in others if (title_of(row), place(row)) not in done]


def settings() -> str:
    """Return the table of earlier models, and of all settings but the distillation's."""
    lines = earlier_models(measured())
    pairs = pairs_of_charts(measured(), SETTINGS)
    lines += [timed_line_of(marked_title(own[0]), own, plain) for own, plain in pairs]
    return markdown((*HEAD, *SECONDS), lines) if lines else NOT_MEASURED


def earlier_models(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """Return a line for each of the states in EARLIER and each judge, compared with the state that
    followed it, of those that this judge scored.
    """
    rows = [row for row in rows if row["variant"] == toybox_jobs.DEFAULT]
    lines = []
    for judge in dict.fromkeys(row["judge"] for row in sorted(rows, key=is_present, reverse=True)):
        scored = [row for row in rows if row["judge"] == judge]
        mark = "" if any(map(is_present, scored)) else " †"
        states = [[row for row in scored if row["setup"] == setup] for setup in states_of(scored)]
        for after, before in itertools.pairwise(states):
            plain = {place(row)[:2]: row for row in after}
            own = [row for row in before if place(row)[:2] in plain]
            if own:
                title = EARLIER[own[0]["setup"]] + mark
                same = [plain[place(row)[:2]] for row in own]
                lines.append(timed_line_of(title, own, same))
    return lines


def states_of(rows: Sequence[Row]) -> list[str]:
    """Return the known states that these rows have, the newest first."""
    found = {row["setup"] for row in rows}
    return [setup for setup in (toybox_jobs.setup(), *EARLIER) if setup in found]


def pairs_of_charts(
    rows: Sequence[Row], charts: Iterable[str]
) -> Iterator[tuple[list[Row], list[Row]]]:
    """Yield the pairs of each variant of these charts."""
    keys = dict.fromkeys(one.key for chart in charts for one in toybox_options.CHARTS[chart]())
    return (pair for key in keys for pair in pairs_of(rows, *key))


def pairs_of(
    rows: Sequence[Row], name: str, x: str, base: str = toybox_jobs.DEFAULT
) -> list[tuple[list[Row], list[Row]]]:
    """Return the rows of a variant, and those of ``base`` with the same prompts and seeds: one
    pair for each state of models, configuration and judge with which both were measured, or that of
    the present one alone if it has as many as ENOUGH.
    """
    plain = {place(row): row for row in rows if row["variant"] == base}
    same = (row for row in rows if (row["variant"], row["x"]) == (name, x) and place(row) in plain)
    groups = grouped(same, lambda row: place(row)[2:])
    present = [own for own in groups.values() if is_present(own[0]) and len(own) >= ENOUGH]
    return [(own, [plain[place(row)] for row in own]) for own in present or groups.values()]


def place(row: Row) -> tuple[str, ...]:
    return row["index"], row["seed"], row["setup"], row["judge"]


def marked_title(row: Row) -> str:
    return title_of(row) + ("" if is_present(row) else " †")


def line_of(title: str, own: list[Row], plain: list[Row]) -> tuple[str, ...]:
    recognised = [values_of(rows, recognised_share) for rows in (own, plain)]
    faces = [values_of(rows, multi_face) for rows in (own, plain)]
    return (
        title,
        counts_of(own),
        mean(recognised[0]), difference(*recognised),
        mean(faces[0]), difference(*faces),
        *(haze(rows) for rows in (own, plain)),
    )  # fmt: skip


def timed_line_of(title: str, own: list[Row], plain: list[Row]) -> tuple[str, ...]:
    """Return the same with the seconds of both."""
    seconds = (median_of(rows, "cpu_seconds") for rows in with_seconds(own, plain))
    return *line_of(title, own, plain), *seconds


def haze(rows: list[Row]) -> str:
    """Return the mean alpha around the object, in percent; nothing where a row has none."""
    values = [row["haze"] for row in rows]
    return f"{100 * statistics.fmean(map(float, values)):.1f}" if all(values) else ""


def looks() -> str:
    """Return the table of saturation, diversity over the seeds and evaluations of the 2D model, of
    the runs that have them; those on a GPU replace those on CPUs.
    """
    rows = {(title_of(row), place(row)): row for row in runs_with_looks()}.values()
    counts, diverse = relative("evaluations", rows), diversities()
    groups = grouped(rows, lambda row: (row["variant"], row["x"]))
    lines = [
        (
            title_of(own[0]),
            counts_of(own),
            median_of(own, "saturation", 2),
            f"{100 * statistics.fmean(float(row['at_limits']) for row in own):.1f}",
            diverse.get(title_of(own[0]), ""),
            median_of(own, "evaluations"),
            f"{counts[title_of(own[0])]:.1f}" if title_of(own[0]) in counts else "",
        )
        for own in (groups[one.key] for one in toybox_options.looks() if one.key in groups)
    ]
    head = ("variant", "prompts × seeds", "saturation / the object's", "pixels at a limit, %")
    head += ("diversity", "evaluations", "/ those of toybox.yaml")
    return markdown(head, lines) if lines else NOT_MEASURED


def runs_with_looks() -> list[Row]:
    """Return the rows of the present state that have saturation and evaluations, those of CPUs
    first.
    """
    both = (*timed_runs(), *measured(toybox_jobs.GPU_CHART))
    return [row for row in both if row["saturation"] and is_present(row)]


def diversities() -> dict[str, str]:
    """Return the mean diversity over the prompts of each variant that was measured."""
    present = toybox_jobs.setup()
    rows = [row for row in rows_of(DIVERSITY, RESULTS) if row["setup"] == present]
    groups = grouped(rows, title_of)
    means = {
        name: statistics.fmean(float(row["diversity"]) for row in own)
        for name, own in groups.items()
    }
    return {name: f"{value:.3f}" for name, value in means.items()}


def seconds_of_variants() -> dict[str, float]:
    """Return :func:`relative_seconds` of the runs that have seconds. All scales of a distillation
    have those of the scale that was timed.
    """
    ratios = relative_seconds(timed_runs())
    timed = {title.rpartition(" ")[0]: ratio for title, ratio in ratios.items()}
    variants = (one for one in toybox_options.distillations() if one.name in timed)
    return {" ".join(one.key): timed[one.name] for one in variants} | ratios


def relative_seconds(rows: Iterable[Row]) -> dict[str, float]:
    """Return the median ratio of each variant's seconds to those of toybox.yaml; see
    :func:`relative`.
    """
    return relative("cpu_seconds", rows)


def relative(column: str, rows: Iterable[Row]) -> dict[str, float]:
    """Return the median ratio of each variant's value in a column to that of toybox.yaml with the
    same prompt, seed and present models on the same machine.
    """

    def where(row: Row) -> tuple[str, ...]:
        return *place(row), row["machine"]

    known = grouped((row for row in rows if row[column] and is_present(row)), title_of)
    plain = {where(row): float(row[column]) for row in known[toybox_jobs.DEFAULT]}
    ratios = {
        title: [float(row[column]) / plain[where(row)] for row in own if where(row) in plain]
        for title, own in known.items()
    }
    return {title: statistics.median(found) for title, found in ratios.items() if found}


def timed_runs() -> list[Row]:
    """Return the rows that have seconds, and those of runs that were made only for these."""
    return [*measured(), *rows_of(toybox_jobs.CHART, RESULTS)]


def with_seconds(own: list[Row], plain: list[Row]) -> tuple[list[Row], list[Row]]:
    """Return the rows of the pairs in which both have CPU seconds."""
    pairs = zip(own, plain, strict=True)
    timed = [pair for pair in pairs if all(row["cpu_seconds"] for row in pair)]
    return [first for first, _ in timed], [second for _, second in timed]


def counts_of(rows: Sequence[Row]) -> str:
    """Return the numbers of prompts and of seeds, both of them where seeds aren't complete."""
    seeds = [len(same) for same in grouped(rows, lambda row: row["index"]).values()]
    shown = " to ".join(map(str, sorted({min(seeds), max(seeds)})))
    return f"{len(seeds)} × {shown}"


def values_of(rows: list[Row], measure: Callable[[Row], float]) -> dict[str, float]:
    """Return the mean of each prompt."""
    return per_prompt([row["prompt"] for row in rows], np.array([measure(row) for row in rows]))


def recognised_share(row: Row) -> float:
    names = [name for name in toybox_jobs.ATTRIBUTES if asks_for(row["prompt"], name)]
    return float(np.mean([float(row[name]) for name in names]))


def multi_face(row: Row) -> float:
    return float(row["multi_face"])


def mean(values: dict[str, float]) -> str:
    known = [value for value in values.values() if not math.isnan(value)]
    return f"{100 * statistics.fmean(known):.0f}" if known else ""


def difference(own: dict[str, float], plain: dict[str, float]) -> str:
    """Return the mean paired difference, with its bootstrap interval if there are two prompts."""
    found = paired(own, plain)
    if found.count < 2:
        return f"{100 * found.mean:+.0f}" if found.count else ""
    return f"{100 * found.mean:+.0f} ({100 * found.low:+.0f} – {100 * found.high:+.0f})"
