"""The benchmarks of the variants of score distillation, with tiny steps and without training."""

import csv
import json

import numpy as np
import pytest

from benchmarks.quality import (
    error_views,  # noqa: F401, registers parts
    forked,
    runs,
    variant_charts,
    variant_overhead,
    variant_tables,
    variants,
)
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core import images
from threestudio_gaussiandreamer.guidance.variants import Variant
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config

register_parts()


def test_every_variant_is_timed_with_its_calls(tmp_path, monkeypatch):
    monkeypatch.setattr(variant_overhead, "RESULTS", tmp_path / "overhead.csv")
    sizes = ["--gaussians", "20", "--sizes", "16", "--views", "1", "--pairs", "2"]
    monkeypatch.setattr("sys.argv", ["", *sizes])
    variant_overhead.main()
    with (tmp_path / "overhead.csv").open() as file:
        rows = {row["variant"]: row for row in csv.DictReader(file)}
    assert set(rows) == set(variant_overhead.variant_names())
    calls = {name: float(row["evaluations"]) for name, row in rows.items()}
    assert calls["sds-variant"] == calls["cfd-variant"] == 1  # an evaluation of both prompts
    assert calls["sdi-variant"] > 1 and calls["ism-variant"] > 1


def test_the_variants_of_extensions_are_not_timed(monkeypatch):
    own = type("Extension", (Variant,), {"__module__": "custom.extension"})
    monkeypatch.setattr(
        variant_overhead, "find", {"sds-variant": find("sds-variant"), "a": own}.get
    )
    monkeypatch.setattr(variant_overhead, "names", lambda: ["sds-variant", "a"])
    assert variant_overhead.variant_names() == ["sds-variant"]


def test_every_line_names_a_registered_variant():
    for line in variants.LINES.values():
        assert issubclass(find(f"{line.variant}-variant"), Variant)


@pytest.fixture
def charts(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "CHARTS", tmp_path)
    return tmp_path


def fake_train(folder, options):
    """Write what a run writes: scores that fall with the distance of the scale from 8.5."""
    save = folder / "demo/run/save"
    logs = folder / "demo/run/csv_logs/version_0"
    save.mkdir(parents=True), logs.mkdir(parents=True)
    (logs / "metrics.csv").write_text("step,train/evaluations\n0,8\n1,\n2,4\n")
    (save / "it9-test").mkdir()
    (save / "it9-test/0.png").write_bytes(b"a picture")
    scale = options["system.guidance.guidance_scale"]
    scores = {"psnr": 30 - abs(scale - 8.5), "ssim": 0.9, "cpu_seconds": 2.0}
    last = scores | {"step": variants.STEPS, "cpu_seconds": 5.0}
    content = {"curve": [scores | {"step": 30}, last], "result": last}
    (save / "metrics.json").write_text(json.dumps(content))
    return save


def in_this_process(function, items, jobs, deadline):
    for item in items:
        yield item, function(item)


def test_a_line_runs_at_its_best_scale_only_and_once(charts, monkeypatch):
    monkeypatch.setattr(forked, "train", fake_train)
    monkeypatch.setattr(forked, "results", in_this_process)
    chosen = ["--lines", "SDS, clipped", "--objects", "toy.glb", "a/spot.glb"]
    pictures = ["--pictures", str(charts / "pictures")]
    for _ in range(2):
        monkeypatch.setattr("sys.argv", ["", *chosen, *pictures, "--seeds", "0"])
        with pytest.raises(SystemExit) as end:
            variants.main()
        rows = runs.rows_of("variants")
        assert not end.value.code and len(rows) == 2 * (4 + 2 + 2)
    assert rows[0]["evaluations"] == f"{6 * 30}" and rows[1]["evaluations"] == f"{6 * 240}"
    spot = {(row["truth"], row["x"]) for row in rows if row["object"] == "spot"}
    assert spot == {(variants.BINNED, "8.5"), (variants.BINNED, "101"), (variants.BLIND, "8.5")}
    kept = charts / "pictures/direction-bins_SDS-clipped_8.5_spot_0/0.png"
    assert kept.read_bytes() == b"a picture"


def test_a_run_that_fails_is_named_and_the_others_go_on(charts, monkeypatch, capsys):
    def results(function, items, jobs, deadline):
        for item in items:
            yield item, RuntimeError("no memory") if item.scale == 2 else function(item)

    monkeypatch.setattr(forked, "train", fake_train)
    monkeypatch.setattr(forked, "results", results)
    monkeypatch.setattr("sys.argv", ["", "--lines", "CSD"])
    with pytest.raises(SystemExit) as end:
        variants.main()
    assert end.value.code == "1 runs failed"
    assert "CSD, 2, toy, 0: no memory" in capsys.readouterr().err
    assert {row["x"] for row in runs.rows_of("variants")} == {"8.5", "31", "101"}


def row(label, x, psnr, **place):
    own = {"truth": variants.BINNED, "object": "toy", "seed": "0", "step": "9", "machine": "a"}
    scores = {"multi_face": "0", "out_of_gamut": "0.01", "saturation": "1", "cpu_seconds": "2"}
    given = {"variant": label, "x": x, "psnr": psnr, "evaluations": "100"}
    return own | scores | given | place


def test_the_papers_recipe_is_drawn_beside_a_better_scale():
    rows = [row(variants.CLIPPED, "101", "20"), row(variants.CLIPPED, "8.5", "25")]
    shown = variant_charts.at_best(rows, variants.DISTILLATIONS)
    assert [found["variant"] for found in shown] == ["SDS, clipped, s = 8.5", "the paper's recipe"]


def test_the_scale_of_a_lines_own_paper_is_marked():
    rows = [row("ISM", "8.5", "20"), row("CSD", "8.5", "20")]
    shown = variant_charts.at_best(rows, variants.LINES)
    assert [found["variant"] for found in shown] == ["ISM, s = 8.5 (its paper's)", "CSD, s = 8.5"]


def test_diversity_is_the_difference_between_seeds(charts, monkeypatch):
    rows = [row("SDS", "2", "20", seed=seed) for seed in "012"] + [row("CSD", "2", "20")]
    for found, level in zip(rows, (0, 51, 102, 0), strict=True):
        key = tuple(found[name] for name in variants.KEY)
        folder = variants.picture_folder(charts / "pictures", key)
        folder.mkdir(parents=True)
        for view in range(2):
            images.write(folder / f"{view}.png", np.full((4, 4, 3), level, np.uint8))
    variant_charts.write_diversity(charts / "pictures", rows)
    (written,) = runs.rows_of("variants_diversity")
    assert written["variant"] == "SDS" and written["seeds"] == "3"
    assert float(written["diversity"]) == pytest.approx((0.2 + 0.4 + 0.2) / 3, abs=1e-3)
    variant_charts.write_diversity(charts / "elsewhere", rows)
    assert runs.rows_of("variants_diversity") == [written]  # rows without pictures stay


def test_timesteps_are_tried_with_a_ball_too(charts, monkeypatch):
    all_lines = variants.DISTILLATIONS | variants.CHEAPER
    lines = [name for name in all_lines if name.startswith("SDS, t ")]
    assert set(variants.FROM_BALL) == {f"{name}, from a ball" for name in ("SDS", *lines)}
    for name in lines:
        ball = variants.LINES[f"{name}, from a ball"].options
        assert ball == all_lines[name].options | variants.BALL
    rows = [row("SDS, t = 0.2, from a ball", "2", "20"), row("SDS, t = 0.2", "2", "25")]
    monkeypatch.setattr(variant_tables, "rows_of", lambda chart: rows)
    assert "| SDS, t = 0.2, from a ball | 20.0 |" in variant_tables.from_ball()


def test_a_cheaper_line_is_compared_with_sds_of_as_many_evaluations():
    rows = [
        row("SDS, half the steps", "2", "20", evaluations="100"),
        row("SDS", "2", "22", evaluations="400"),
        row("SDS, 2 views", "2", "23", evaluations="200"),
        row("SDS, 8 views", "2", "23", evaluations="900"),
    ]
    best = variants.best_scales(rows)
    gains = [variant_tables.gain_of(found, rows, best) for found in rows]
    assert gains == [pytest.approx(0), pytest.approx(0), pytest.approx(2), None]


@pytest.mark.parametrize("label", variants.LINES)
def test_the_options_of_every_line_are_valid(label):
    options = variants.options_of(label, 8.5) | {"system.guidance.mesh": "toy.glb"}
    overrides = [f"{key}={value}" for key, value in options.items()]
    check_config(load_config(runs.ROOT / "configs/demo.yaml", cli_args=overrides))


def test_scales_are_compared_with_the_seed_that_all_were_run_with():
    """Other seeds, which only the best scale has, may be worse."""
    runs_of = [("31", "0", 19.2), ("8.5", "0", 19.1), ("31", "1", 18.9), ("31", "2", 18.8)]
    common = {"truth": variants.BINNED, "variant": "VSD", "object": "toy", "step": "240"}
    rows = [common | {"x": x, "seed": seed, "psnr": str(dB)} for x, seed, dB in runs_of]
    assert variants.best_scales(rows) == {"VSD": "31"}
    more = [
        common | {"x": "8.5", "seed": seed, "psnr": dB} for seed, dB in (("1", 19), ("2", 18.7))
    ]
    assert variants.best_scales(rows + more[:1]) == {"VSD": "31"}
    assert variants.best_scales(rows + more) == {"VSD": "8.5"}
