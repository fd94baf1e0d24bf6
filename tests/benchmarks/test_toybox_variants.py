"""The tables that compare variants of toybox.yaml with toybox.yaml itself."""

import math

from benchmarks.quality import (
    chart_runs,
    toybox,
    toybox_jobs,
    toybox_tables,
    toybox_variants,
)
from benchmarks.quality.toybox_jobs import DEFAULT, Variant
from tests.helpers.toybox_rows import row


def test_runs_on_a_gpu_replace_those_on_cpus(monkeypatch):
    """Runs on CPUs are shown of the variants, prompts and seeds for which the GPU has none."""
    charts = {toybox.CHART: [row(kind="0"), row(index="1")], toybox_jobs.GPU_CHART: []}
    monkeypatch.setattr(toybox_variants, "measured", lambda chart=toybox.CHART: charts[chart])
    monkeypatch.setattr(toybox_variants, "timed_runs", list)
    monkeypatch.setattr(toybox_variants, "distilled", list)
    assert toybox_variants.distillations() == toybox_tables.NOT_MEASURED
    charts[toybox_jobs.GPU_CHART] += [row(), row(variant="CSD", x="4", colors="0")]
    lines = toybox_variants.distillations().splitlines()
    assert lines[2].startswith("| toybox.yaml on CPUs | 1 × 1 | 50 | -50 |")
    assert lines[3].startswith("| CSD 4 | 1 × 1 | 50 | -50 |") and len(lines) == 4
    assert len({line.count("|") for line in lines}) == 1
    on_cpus = [row(variant="CSD", x="4"), row(variant="CSD", x="4", index="1", kind="0")]
    charts[toybox.CHART] += [*on_cpus, row(variant="NFSD", x="4")]
    *others, csd, nfsd = toybox_variants.distillations().splitlines()
    assert csd.startswith("| CSD 4 | 2 × 1 | 50 | -50 |") and others == lines[:3]
    assert nfsd.startswith("| NFSD 4 | 1 × 1 | 100 | +0 |")
    charts[toybox.CHART] = []
    assert toybox_variants.distillations().splitlines()[2:] == lines[3:]
    charts[toybox_jobs.GPU_CHART] = [one | {"setup": "a"} for one in charts[toybox_jobs.GPU_CHART]]
    assert [line[:10] for line in toybox_variants.distillations().splitlines()[2:]] == [
        "| CSD 4 † "
    ]


def test_a_distilled_model_is_compared_with_the_one_that_it_was_made_of(monkeypatch):
    """Only where that was run with the same prompt and seed."""
    monkeypatch.setattr(toybox_variants, "all_runs", lambda: [row(), row(variant="CSD", index="1")])
    found = [row(setup="a", kind="0"), row(setup="a", index="1"), row(setup="a", seed="1")]
    monkeypatch.setattr(toybox_variants, "rows_of", lambda chart, folder: found)
    (line,) = toybox_variants.distilled()
    assert line[:4] == ("guidance in one evaluation", "1 × 1", "50", "-50")
    found.clear()
    assert toybox_variants.distilled() == []


def test_settings_on_a_gpu_are_compared_there_and_parts_of_growing_with_the_same_prior(monkeypatch):
    """Of four variants two are settings, of which one is a part of growing with a wrong prior. It
    is compared with that prior and all of growing, not with toybox.yaml; nothing else is.
    """
    wrong = toybox_jobs.WRONG_PRIOR
    rows = [row(), row(variant="CSD", x="4"), row(variant=wrong, x="0", kind="0")]
    charts = {toybox.CHART: [], toybox_jobs.GPU_CHART: rows}
    monkeypatch.setattr(toybox_variants, "measured", lambda chart=toybox.CHART: charts[chart])
    assert toybox_variants.wrong_priors() == toybox_tables.NOT_MEASURED
    rows.append(row(variant=f"{wrong}, no growing", x="0", kind="0", colors="0"))
    lines = toybox_variants.settings_on_gpu().splitlines()[2:]
    assert lines[0].startswith(f"| {wrong} | 1 × 1 | 50 | -50 |")
    assert lines[1].startswith(f"| {wrong}, no growing | 1 × 1 | 0 | -100 |") and len(lines) == 2
    head, _, line = toybox_variants.wrong_priors().splitlines()
    assert head.count(f"− {wrong}") == 2 and toybox_jobs.DEFAULT not in head
    assert line.startswith(f"| {wrong}, no growing | 1 × 1 | 0 | -50 |")


def test_seeds_that_are_not_complete_are_told():
    rows = [row(), row(seed="1"), row(index="1", prompt="a blue car")]
    assert toybox_variants.counts_of(rows) == "2 × 1 to 2"
    assert toybox_variants.counts_of(rows[:2]) == "1 × 2"


def test_variants_are_compared_on_the_prompts_and_seeds_that_both_have(monkeypatch):
    """Of three prompts the variant has two; it misses the accessory that one of them asks for."""
    right = dict.fromkeys(toybox_tables.RECOGNIZED, "1") | {"multi_face": "0.25", "seed": "0"}
    right |= {"setup": toybox_jobs.setup(), "judge": toybox_jobs.judge_of(), "haze": "0.01"}
    prompts = {"0": "a red fox", "1": "a red fox with a blue hat", "2": "a blue car"}
    rows = [
        right | {"variant": DEFAULT, "x": "0", "index": i, "prompt": text, "cpu_seconds": "50"}
        for i, text in prompts.items()
    ]
    other = {"variant": "CSD", "x": "4", "cpu_seconds": "70", "haze": "0.02"}
    rows += [rows[0] | other, rows[1] | other | {"accessory": "0", "multi_face": "nan"}]
    monkeypatch.setattr(toybox_variants, "measured", lambda: rows)
    monkeypatch.setattr(
        toybox_variants.toybox_options,
        "CHARTS",
        {"mine": lambda: [Variant("CSD", 4), Variant("no")]},
    )
    monkeypatch.setattr(toybox_variants, "SETTINGS", ["mine"])
    monkeypatch.setattr(toybox_variants, "EARLIER", {})
    head, _, line = toybox_variants.settings().splitlines()
    assert line.startswith("| CSD 4 | 2 × 1 | 83 | -17 (")  # kind and colours of three attributes
    assert line.endswith("| 25 | +0 | 2.0 | 1.0 | 70 | 50 |") and len(head.split("|")) == 12
    earlier = [row | {"setup": "earlier"} for row in rows]
    rows.append(earlier[0] | other)  # isn't paired with results of other models
    assert toybox_variants.settings().splitlines()[2:] == [line]
    rows[len(rows) - 1 :] = earlier
    marked = line.replace("CSD 4", "CSD 4 †")
    assert toybox_variants.settings().splitlines()[2:] == [line, marked]
    monkeypatch.setattr(toybox_variants, "EARLIER", {"none": "others", "earlier": "the first"})
    (first,) = toybox_variants.earlier_models(rows)
    assert first[:4] == ("the first", "3 × 1", "100", "+0 (+0 – +0)")
    assert toybox_variants.earlier_models(rows[:3]) == []


def test_seconds_are_of_the_pairs_that_have_them():
    own = [row(cpu_seconds="10"), row(seed="1", cpu_seconds=""), row(seed="2", cpu_seconds="30")]
    plain = [row(cpu_seconds="5"), row(cpu_seconds="7"), row(cpu_seconds="")]
    assert toybox_variants.timed_line_of("mine", own, plain)[-2:] == ("10", "5")
    assert toybox_variants.timed_line_of("mine", own[1:], plain[1:])[-2:] == ("", "")
    assert chart_runs.median(own, "cpu_seconds") == 20
    assert math.isnan(chart_runs.median(own[1:2], "cpu_seconds"))


def test_seconds_are_relative_to_those_of_the_same_prompt_on_the_same_machine(monkeypatch):
    plain = [row(cpu_seconds="10"), row(index="1", cpu_seconds="20")]
    own = {"variant": "CSD", "x": "4", "machine": "a"}
    rows = [one | {"machine": machine} for one in plain for machine in "ab"]
    rows += [row(cpu_seconds="15") | own, row(index="1", cpu_seconds="80") | own]
    rows += [row(cpu_seconds="") | own, row(cpu_seconds="99", seed="1") | own]
    assert toybox_variants.relative_seconds(rows) == {DEFAULT: 1.0, "CSD 4": 2.75}
    measured = [one | {"cpu_seconds": ""} for one in rows]
    charts = {toybox.CHART: measured, toybox_jobs.GPU_CHART: []}
    monkeypatch.setattr(toybox_variants, "measured", lambda chart=toybox.CHART: charts[chart])
    results = {toybox.CHART: rows, toybox_variants.DISTILLED: []}
    monkeypatch.setattr(toybox_variants, "rows_of", lambda chart, folder: results[chart])
    assert (
        toybox_variants.distillations()
        .splitlines()[2]
        .endswith("| 100 | +0 | 100.0 | 100.0 | 2.8 |")
    )
    assert toybox_variants.seconds_of_variants() == dict.fromkeys(
        ("CSD 2", "CSD 4", "CSD 8"), 2.75
    ) | {DEFAULT: 1.0}


def test_the_scales_of_the_papers_are_marked():
    titles = ("ISM 7.5", "ISM 4", "CSD 8", DEFAULT)
    found = [toybox_variants.paper_marked(title) for title in titles]
    assert found == ["ISM 7.5 (its paper's)", *titles[1:]]


def test_haze_is_shown_where_all_rows_have_it():
    assert toybox_variants.haze([row(haze="0.01"), row(haze="0.02")]) == "1.5"
    assert toybox_variants.haze([row(haze="0.01"), row(haze="")]) == ""


def test_rows_of_another_judge_are_not_of_the_present_state():
    """Of two scores of the same runs, those of the bundled judge are shown."""
    plain = [row(), row(judge="another", kind="0")]
    assert [toybox_tables.is_present(one) for one in plain] == [True, False]
    mine = [one | {"variant": "mine"} for one in plain]
    assert toybox_variants.pairs_of(plain + mine[1:], "mine", "0") == [(mine[1:], plain[1:])]
    assert toybox_variants.pairs_of(plain[:1] + mine[1:], "mine", "0") == []


def test_earlier_models_are_compared_by_the_same_judge(monkeypatch):
    """Each state is compared with the next newer one that the judge scored."""
    rows = [row(setup="a", judge="first"), row(setup="b", judge="first")]
    rows += [row(), row(setup="b", kind="0")]
    monkeypatch.setattr(toybox_variants, "EARLIER", {"b": "state b", "a": "state a"})
    lines = toybox_variants.earlier_models(rows)
    assert [line[:4] for line in lines] == [
        ("state b", "1 × 1", "50", "-50"),
        ("state a †", "1 × 1", "100", "+0"),
    ]


def test_looks_are_of_the_rows_that_have_them(monkeypatch):
    seen = {"saturation": "1.5", "at_limits": "0.02", "evaluations": "1200", "machine": "a"}
    csd = seen | {"variant": "CSD", "x": "4", "saturation": "1.75", "evaluations": "3000"}
    rows = [row(**seen), row(**seen, index="1"), row(**csd), row(saturation="")]
    monkeypatch.setattr(toybox_variants, "timed_runs", lambda: rows)
    on_gpu = [row(**seen | {"at_limits": "0.04"}, index="1")]
    monkeypatch.setattr(toybox_variants, "measured", {toybox_jobs.GPU_CHART: on_gpu}.get)
    place = {"variant": "CSD", "setup": toybox_jobs.setup()}
    values = (("4", "0.1"), ("4", "0.2"), ("8", "0.5"))
    found = [place | {"x": x, "diversity": value} for x, value in values]
    monkeypatch.setattr(toybox_variants, "rows_of", lambda chart, folder: found)
    assert toybox_variants.looks().splitlines()[2:] == [
        "| toybox.yaml | 2 × 1 | 1.50 | 3.0 |  | 1200 | 1.0 |",
        "| CSD 4 | 1 × 1 | 1.75 | 2.0 | 0.150 | 3000 | 2.5 |",
    ]


def test_ablations_have_both_priors_in_one_table(monkeypatch):
    """Runs on a GPU replace those on CPUs of the same prompt and seed."""
    wrong = toybox_jobs.WRONG_PRIOR
    on_gpu = [row(), row(variant="no growing", x="0", kind="0"), row(variant=wrong, colors="0")]
    on_cpus = [row(variant="no growing", x="0"), row(variant="Gaussians", x="8000", index="1")]
    on_cpus += [row(index="1"), row(variant=f"{wrong}, Gaussians", x="8000", kind="0", colors="0")]
    charts = {toybox.CHART: on_cpus, toybox_jobs.GPU_CHART: on_gpu}
    monkeypatch.setattr(toybox_variants, "measured", lambda chart=toybox.CHART: charts[chart])
    assert toybox_variants.ablations().splitlines()[2:] == [
        "| all of it | 2 × 1 | 100 |  | 100 | 1 × 1 | 50 |  | 100 |",
        "| no growing | 1 × 1 | 50 | -50 | 100 |  |  |  |  |",
        "| Gaussians 8000 | 1 × 1 | 100 | +0 | 100 | 1 × 1 | 0 | -50 | 100 |",
    ]
