"""The benchmarks of the variants of score distillation, with tiny steps and without training."""

import csv
import json

import pytest

from benchmarks.quality import runs, variant_overhead, variants
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config

register_parts()


def test_every_variant_is_timed_with_its_calls(tmp_path, monkeypatch):
    monkeypatch.setattr(variant_overhead, "RESULTS", tmp_path / "overhead.csv")
    sizes = ["--gaussians", "20", "--size", "16", "--views", "1", "--pairs", "2"]
    monkeypatch.setattr("sys.argv", ["", *sizes])
    variant_overhead.main()
    with (tmp_path / "overhead.csv").open() as file:
        rows = {row["variant"]: row for row in csv.DictReader(file)}
    assert set(rows) == set(variant_overhead.variant_names())
    calls = {name: float(row["evaluations"]) for name, row in rows.items()}
    assert calls["sds-variant"] == calls["cfd-variant"] == 1  # an evaluation of both prompts
    assert calls["sdi-variant"] > 1 and calls["ism-variant"] > 1


def test_every_line_names_a_registered_variant():
    assert {find(f"{line.variant}-variant") for line in variants.LINES.values()}


@pytest.fixture
def charts(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "CHARTS", tmp_path)
    return tmp_path


def fake_train(folder, mesh, seed, options):
    """Write what a run writes: scores that fall with the distance of the scale from 8.5."""
    save = folder / "demo/run/save"
    logs = folder / "demo/run/csv_logs/version_0"
    save.mkdir(parents=True), logs.mkdir(parents=True)
    (logs / "metrics.csv").write_text("step,train/evaluations\n0,8\n1,\n2,4\n")
    scale = options["system.guidance.guidance_scale"]
    scores = {"psnr": 30 - abs(scale - 8.5) + seed, "ssim": 0.9, "cpu_seconds": 2.0}
    last = scores | {"step": variants.STEPS, "cpu_seconds": 5.0}
    content = {"curve": [scores | {"step": 30}, last], "result": last}
    (save / "metrics.json").write_text(json.dumps(content))
    return save


def test_runs_are_measured_once_and_each_line_is_drawn_at_its_best_scale(charts, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(runs, "train", fake_train)
    drawn = []
    monkeypatch.setattr(variants, "draw", lambda name, chart, rows: drawn.append((name, rows)))
    chosen = ["--variants", "csd", "--scales", "2", "8.5", "--jobs", "1"]
    for seeds, expected in ((["0"], 4), (["0", "1"], 8)):
        monkeypatch.setattr("sys.argv", ["", *chosen, "--seeds", *seeds])
        with pytest.raises(SystemExit) as end:
            variants.main()
        rows = runs.rows_of("variants")
        assert end.value.code == 0 and len(rows) == expected
    assert rows[0]["evaluations"] == f"{6 * 30}" and rows[1]["evaluations"] == f"{6 * 240}"
    assert [name for name, _ in drawn[-2:]] == ["variants_seconds", "variants_evaluations"]
    assert {row["variant"] for row in drawn[-1][1]} == {"CSD, s = 8.5"}


def test_the_papers_recipe_is_drawn_beside_a_better_scale():
    place = {"object": "toy", "seed": "0", "step": "9"}
    rows = [
        place | {"variant": variants.CLIPPED, "x": x, "psnr": psnr}
        for x, psnr in (("101", "20"), ("8.5", "25"))
    ]
    assert [row["variant"] for row in variants.at_best(rows)] == [
        "SDS, clipped, s = 8.5",
        "the paper's recipe",
    ]


@pytest.mark.parametrize("label", variants.LINES)
def test_the_options_of_every_line_are_valid(label):
    options = variants.options_of(label, 8.5) | {"system.guidance.mesh": "toy.glb"}
    overrides = [f"{key}={value}" for key, value in options.items()]
    check_config(load_config(runs.ROOT / "configs/demo.yaml", cli_args=overrides))
