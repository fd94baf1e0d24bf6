"""The benchmark of text to 3D with learned models: prompts, variants, order, rows and tables."""

import argparse
import contextlib
import itertools
import os
import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from benchmarks.quality import (
    chart_runs,
    feature_reuse,  # noqa: F401, registers a guidance
    runs,
    toybox,
    toybox_charts,
    toybox_jobs,
    toybox_options,
    toybox_scores,
    toybox_tables,
    toybox_variants,
)
from benchmarks.quality.toybox_jobs import CONFIG, DEFAULT, SAMPLES, STEPS, TRUTH, Variant, prompts
from tests.helpers.toybox_rows import row
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.models.bundled import DIFFUSION, JUDGE, RECORD
from threestudio_gaussiandreamer.toybox import recognition
from threestudio_gaussiandreamer.toybox.prompt_attributes import attributes_in
from threestudio_gaussiandreamer.toybox.world import withheld

register_parts()
RUNS = [
    variant
    for variant in itertools.chain.from_iterable(make() for make in toybox_options.CHARTS.values())
    if variant.name not in (SAMPLES, TRUTH)
]


def test_prompts_are_of_withheld_combinations_or_of_others():
    for sort in ("withheld", "seen"):
        found = prompts(sort, 20)
        assert len({prompt.text for prompt in found}) == 20
        for prompt in found:
            assert withheld(attributes_in(prompt.text)) == prompt.withheld == (sort == "withheld")


@pytest.mark.parametrize("variant", RUNS, ids=lambda variant: "-".join(variant.key))
def test_the_options_of_every_variant_are_accepted(variant, tmp_path):
    options = toybox.QUICK | toybox_jobs.options_of(variant, "a red fox with a green scarf")
    words = [f"{key}={value}" for key, value in options.items()]
    prompt = "system.prompt_processor.prompt=a red fox"
    cfg = load_config(runs.ROOT / "configs/toybox.yaml", cli_args=[*words, prompt])
    check_config(cfg)


def test_schedules_are_scaled_to_the_steps():
    options, guidance = toybox_options.steps(STEPS // 2), CONFIG["system"]["guidance"]
    start, high, low, end = guidance["max_step_percent"]
    assert options["system.guidance.max_step_percent"] == [start // 2, high, low, start // 2 + 1]
    rates = [value for name, value in options.items() if ".lr_" in name]
    assert len(rates) == 5 and all(rate[-1] == STEPS // 2 for rate in rates)
    own = {"system.guidance.max_step_percent": [start, high, low, end]}
    assert own.items() <= toybox_options.steps(STEPS).items()


def test_the_draft_is_a_variant_that_was_measured():
    draft = toybox_options.overlay("configs/toybox-draft.yaml")
    (variant,) = (one for one in toybox_options.cheaper() if one.options == draft)
    assert variant.key == ("steps with one prediction", "4")


def score_nothing(monkeypatch) -> None:
    monkeypatch.setattr(toybox_scores, "of_run", lambda folder, text, models: {"kind": 1.0})
    monkeypatch.setattr(toybox_scores, "looks_of", lambda folder, prompt: {})
    monkeypatch.setattr(toybox, "evaluations_per_step", lambda folder: 8.5)


def test_a_kept_run_is_only_scored(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(toybox, "run", lambda task, folder: ran.append(folder.mkdir(parents=True)))
    score_nothing(monkeypatch)
    task = toybox.Task(Variant(DEFAULT), prompts("seen", 1)[0], 0, "models", tmp_path)
    assert not toybox.needs_no_run(task)
    assert toybox.needs_no_run(task._replace(variant=Variant(toybox_jobs.TRUTH)))
    first, second = toybox.measured(task), toybox.measured(task)
    assert first == second and first["kind"] == 1 and first["cpu_seconds"] >= 0
    assert first["evaluations"] == 8.5 * STEPS
    assert len(ran) == 1 and toybox.needs_no_run(task)


def test_another_kind_of_the_same_colour_misleads_the_prior():
    variant = Variant(toybox_jobs.WRONG_PRIOR, wrong_prior=True)
    options = toybox_jobs.options_of(variant, "a red fox with a green scarf")
    assert options["system.geometry.prior.prompt"] == "a red rabbit"


def parsed(monkeypatch, *words) -> argparse.Namespace:
    monkeypatch.setattr("sys.argv", ["", *map(str, words)])
    return toybox.parse_arguments()


def test_tasks_come_in_order_of_priority_and_once(monkeypatch):
    words = ["--charts", "default", "default", "--count", 2, "--seeds", 0, 1]
    arguments = parsed(monkeypatch, "--variant", "mine 2 a.b=[0,1] c=x", *words)
    found = toybox.unique(toybox.tasks(arguments))
    assert [(t.variant.name, t.seed, t.prompt.index) for t in found] == [
        (name, seed, index) for name in ("mine", DEFAULT) for seed in (0, 1) for index in (0, 1)
    ]
    assert found[0].variant == Variant("mine", 2, {"a.b": "[0,1]", "c": "x"})


def test_scoring_alone_needs_the_folder_of_the_runs(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        parsed(monkeypatch, "--only-score")
    assert "give the runs' folder as --keep" in capsys.readouterr().err


def test_of_the_missing_rows_only_those_of_kept_runs_are_scored(monkeypatch, tmp_path):
    words = ["--charts", "default", "--prompts", "seen", "--count", 3, "--keep", tmp_path / "runs"]
    words += ["--out", tmp_path]
    tasks = toybox.missing(parsed(monkeypatch, *words))
    assert len(tasks) == 3
    toybox.kept(tasks[1]).mkdir(parents=True)
    (toybox.kept(tasks[1]) / toybox.RECORD).write_text("1.0")
    assert toybox.missing(parsed(monkeypatch, *words, "--only-score")) == [tasks[1]]
    runs.append_rows(toybox.CHART, toybox.COLUMNS, [toybox.row_of(tasks[1], {})], tmp_path)
    assert toybox.missing(parsed(monkeypatch, *words, "--only-score")) == []


def test_a_kept_run_is_scored_again_by_another_judge(monkeypatch, tmp_path):
    task = toybox.Task(Variant("mine"), prompts("seen", 1)[0], 0, "models", tmp_path)
    key, folder = task.key, toybox.kept(task)
    monkeypatch.setattr(toybox, "judge_of", lambda models: "another")
    assert task.key != key and toybox.kept(task) == folder


def test_runs_with_other_options_are_kept_apart(tmp_path):
    task = toybox.Task(Variant("mine", 1, {"a": "1"}), prompts("seen", 1)[0], 0, "models", tmp_path)
    other = task._replace(variant=Variant("mine", 1, {"a": "2"}))
    assert task.key == other.key and toybox.kept(task) != toybox.kept(other)


def test_runs_on_a_gpu_have_rows_and_folders_of_their_own(monkeypatch, tmp_path):
    given = []

    def launch(words):
        given.append(words)
        (folder,) = (word.partition("=")[2] for word in words if word.startswith("exp_root_dir="))
        Path(folder).mkdir(parents=True)

    monkeypatch.setattr("threestudio_gaussiandreamer.launch.experiment.main", launch)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "a GPU")
    score_nothing(monkeypatch)
    monkeypatch.setattr(
        toybox, "ProcessPoolExecutor", lambda *args, **kwargs: ThreadPoolExecutor(1)
    )
    monkeypatch.setattr(toybox, "require_kernel", lambda: None)
    monkeypatch.setattr("os.environ", dict(os.environ) | {"CUDA_VISIBLE_DEVICES": ""})
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    words = ["", "--charts", "default", "--count", 1, "--keep", tmp_path / "runs"]
    for gpu in ("cpu", "0"):
        monkeypatch.setattr("sys.argv", [*map(str, words), "--gpu", gpu, "--out", str(tmp_path)])
        with pytest.raises(SystemExit) as ended:
            toybox.main()
        assert ended.value.code == 0
    assert [words[words.index("--gpu") + 1] for words in given] == ["cpu", "0"]
    (on_cpu,), (on_gpu,) = (
        runs.rows_of(chart, tmp_path) for chart in (toybox.CHART, toybox_jobs.GPU_CHART)
    )
    assert on_gpu["machine"] == "a GPU" != on_cpu["machine"] and on_gpu["kind"] == "1"
    assert not on_gpu["cpu_seconds"] and on_cpu["cpu_seconds"]


@pytest.mark.parametrize(
    ("before", "count"), [(None, 0), ("3", 0), ("3,4", 2), (None, 1), ("3", 1)]
)
def test_runs_see_one_gpu_which_the_environment_may_name(monkeypatch, before, count):
    environment = {} if before is None else {"CUDA_VISIBLE_DEVICES": before}
    monkeypatch.setattr("os.environ", environment)
    monkeypatch.setattr("torch.cuda.device_count", lambda: count)
    with contextlib.nullcontext() if count == 1 else pytest.raises(SystemExit, match="--gpu 1: "):
        toybox.choose_device("1")
    assert environment["CUDA_VISIBLE_DEVICES"] == (before or "1")
    toybox.choose_device("cpu")
    assert environment["CUDA_VISIBLE_DEVICES"] == ""


def test_a_gpu_is_chosen_by_its_number(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        parsed(monkeypatch, "--gpu", "0,1")
    assert "'0,1' is neither cpu nor the number of a GPU" in capsys.readouterr().err


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Tasks that take 0.05 seconds, of which those of seed 1 fail."""
    done = []

    def measure(task):
        time.sleep(0.05)
        done.append(task.key)
        if task.seed == 1:
            raise RuntimeError("failed")
        scores = {name: 1.0 for name in toybox_tables.RECOGNIZED} | {"cpu_seconds": 2.0}
        prior = {f"prior_{name}": 0.5 for name in toybox_tables.RECOGNIZED}
        return toybox.row_of(task, scores | prior | {"haze": 0.01, "gaussians": 3000})

    monkeypatch.setattr(toybox, "measure", measure)
    return done


def work(monkeypatch, out, *words) -> int:
    arguments = parsed(monkeypatch, "--out", out, "--jobs", 2, *words)
    todo = toybox.unique(toybox.tasks(arguments))
    with ThreadPoolExecutor(2) as pool:
        return toybox.work(todo, arguments, pool)


def test_rows_are_appended_and_failures_counted(monkeypatch, tmp_path, fake):
    words = ["--charts", "default", "--count", 3, "--seeds", 0, 1]
    assert work(monkeypatch, tmp_path, *words) == 3
    rows = runs.rows_of(toybox.CHART, tmp_path)
    assert sorted(row["index"] for row in rows) == ["0", "1", "2"] and len(fake) == 6
    assert {row["variant"] for row in rows} == {DEFAULT} and rows[0]["kind"] == "1"


def test_seconds_of_networks_in_float32_are_left_out_of_the_charts(monkeypatch, tmp_path, fake):
    """Beside those of networks in bfloat16 they can't be compared."""
    words, seconds = ["--charts", "default", "--count", 1], {}
    for place, charts in ((tmp_path / "charts", tmp_path / "charts"), (tmp_path, runs.CHARTS)):
        for native in (True, False):
            monkeypatch.setattr(toybox, "CHARTS", charts)
            monkeypatch.setattr(toybox, "cpu_multiplies_bfloat16", lambda native=native: native)
            assert work(monkeypatch, place, *words) == 0
        seconds[place] = [row["cpu_seconds"] for row in runs.rows_of(toybox.CHART, place)]
    assert seconds == {tmp_path / "charts": ["2", ""], tmp_path: ["2", "2"]}


def test_no_run_is_begun_that_would_end_too_late(monkeypatch, tmp_path, fake):
    words = ["--charts", "default", "--count", 40, "--seconds", 0.2]
    assert work(monkeypatch, tmp_path, *words) == 0
    assert 2 <= len(runs.rows_of(toybox.CHART, tmp_path)) <= 10


def test_rows_become_tables_and_charts(monkeypatch, tmp_path, fake):
    monkeypatch.setattr(toybox_tables, "rows_of", lambda chart: runs.rows_of(chart, tmp_path))
    monkeypatch.setattr(chart_runs, "CHARTS", tmp_path)
    assert toybox_tables.results() == toybox_tables.NOT_MEASURED
    charts = ["default", "guidance", "growing", "distillations"]
    work(monkeypatch, tmp_path, "--charts", *charts, "--count", 8)
    lines = toybox_tables.results().splitlines()
    assert len(lines) == 2 + 2 + 2 and lines[2].startswith(f"| {DEFAULT} | 8 | 100 (100 – 100) |")
    assert lines[3].startswith("| its prior's points | 8 | 50 (50 – 50) |")
    assert re.match(r"Of the 8 prompts of `toybox.yaml`, \d ask for a pattern", lines[-1])
    pytest.importorskip("matplotlib")
    toybox_charts.main()
    drawn = {path.name for path in tmp_path.glob("*.png")}
    assert drawn == {
        "toybox_guidance.png",
        "toybox_settings.png",
        "toybox_distillations.png",
        "toybox_seconds.png",
        "toybox_evaluations.png",
    }


def test_settings_of_a_chart_are_those_of_the_present_state():
    """Of too few prompts, of earlier models, and those that a line shows, none is drawn."""
    plain = [row(index=str(i), prompt=f"a red fox {i}") for i in range(toybox_variants.ENOUGH)]
    own = [one | {"variant": "no growing"} for one in plain]
    few = [one | {"variant": "no perturbation"} for one in plain[1:]]
    steps = [one | {"variant": "steps", "x": "75"} for one in plain]
    earlier = [one | {"setup": "earlier"} for one in (*plain, *few)]
    found = toybox_charts.settings([*plain, *own, *few, *steps, *earlier], toybox_variants.SETTINGS)
    assert [(one.title, one.own, one.plain) for one in found] == [("no growing", own, plain)]


def test_the_configuration_itself_is_a_point_of_a_chart():
    """Its runs of the chart's prompts and seeds aren't made a second time."""
    line = toybox_charts.LINES["toybox_guidance"]
    varied = [row(variant=line.variant, x="8")]
    same, other = row(), row(seed="1")
    found = toybox_charts.default_at(line, varied, [*varied, same, other])
    assert found == [same | {"x": f"{toybox_jobs.GUIDANCE:g}"}]
    for chart, variant in (
        ("guidance", Variant("guidance scale", toybox_jobs.GUIDANCE)),
        ("steps", Variant("steps", STEPS)),
        ("view_contrast", Variant("view contrast", toybox_jobs.CONTRAST)),
    ):
        assert variant.key not in [other.key for other in toybox_options.CHARTS[chart]()]


def test_seeds_are_compared_on_the_prompts_that_all_have(monkeypatch):
    rows = [row(), row(prompt="a blue car", multi_face="0")]
    monkeypatch.setattr(toybox_tables, "measured", lambda: rows)
    assert toybox_tables.seeds() == toybox_tables.NOT_MEASURED
    rows += [row(seed="1", kind="0"), row(seed="2", setup="earlier")]
    first, second = toybox_tables.seeds().splitlines()[2:]
    assert first.startswith("| 0 | 1 | 100 (") and second.startswith("| 1 | 1 | 0 (")


def test_judges_are_compared_on_the_same_pictures(monkeypatch):
    truth = {"variant": TRUTH, "setup": toybox_jobs.WORLD}
    texts = ("a red fox", "a blue car")
    rows = [row(**truth, prompt=text, judge="other", kind="0") for text in texts]
    monkeypatch.setattr(toybox_tables, "measured", lambda: rows)
    assert toybox_tables.judges() == toybox_tables.NOT_MEASURED
    rows.append(row(**truth))
    earlier, present = toybox_tables.judges().splitlines()[2:]
    assert earlier.startswith("| ground truth | other | 1 | 0 (")
    assert present.startswith(f"| ground truth | {toybox_jobs.judge_of()} | 1 | 100 (")


def test_the_judge_is_identified_by_its_file(tmp_path):
    assert toybox_jobs.judge_of().endswith(f"reading {recognition.VERSION}")
    found = set()
    for name, content in (("a", b"one"), ("b", b"two"), ("c", b"one")):
        (tmp_path / name / DIFFUSION).mkdir(parents=True)
        (tmp_path / name / RECORD).touch()
        (tmp_path / name / JUDGE).write_bytes(content)
        found.add(toybox_jobs.judge_of(str(tmp_path / name)))
    assert len(found) == 2 and toybox_jobs.judge_of() not in found


def test_results_of_other_models_are_measured_again(monkeypatch, tmp_path):
    words = ["--charts", "references", "default", "--count", 1, "--out", tmp_path]
    tasks = toybox.missing(parsed(monkeypatch, *words))
    rows = [toybox.row_of(task, {}) for task in tasks]
    runs.append_rows(toybox.CHART, toybox.COLUMNS, rows, tmp_path)
    assert toybox.missing(parsed(monkeypatch, *words)) == []
    found = toybox.missing(parsed(monkeypatch, *words, "--models", tmp_path / "others"))
    assert [task.variant for task in found] == [t.variant for t in tasks]


def test_columns_of_prompts_that_ask_for_nothing_are_left_out():
    asks = toybox_tables.asks_for
    assert asks("a red fox with a scarf", "kind") and not asks("a red fox", "pattern")
    assert asks("a red fox with white dots", "pattern")
    assert asks("a red fox with a blue hat", "accessory") and not asks("a red fox", "accessory")
