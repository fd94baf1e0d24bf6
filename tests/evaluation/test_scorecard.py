"""The scorecard of finished runs: rows, intervals, comparisons, and messages for wrong input."""

import csv
import json
import math

import numpy as np
import pytest
import torch

from tests.evaluation.conftest import run_of
from tests.helpers import tiny_3d_models as tiny
from tests.helpers import tiny_image_reward
from threestudio_gaussiandreamer.evaluation import scorecard, t3bench
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud, write_cloud
from threestudio_gaussiandreamer.toybox import export, models

PROMPTS = ("a red fox", "a red fox", "a blue mug with white dots", "a zebra")
PERSON = "a man in a red shirt and blue trousers jumps"


def finished(folder, prompts):
    for number, prompt in enumerate(prompts):
        run = folder / "gaussiandreamer" / f"run{number}"
        run_of(run, {"prompt_processor": {"prompt": prompt}}, number)
    return folder


def table(folder, column="prompt"):
    with open(folder / "scorecard.csv", newline="") as file:
        return [row[column] for row in csv.DictReader(file)]


@pytest.fixture
def judge(tmp_path):
    torch.manual_seed(0)
    export.write_weights(tmp_path / "judge.safetensors", models.Judge().state_dict())
    return str(tmp_path / "judge.safetensors")


def test_rows_and_intervals_over_prompts(tmp_path, judge, capsys):
    runs = finished(tmp_path / "runs", (*PROMPTS, PERSON))
    arguments = ["--metrics", "judge,janus", "--judge", judge, "--output", str(tmp_path / "out")]
    assert scorecard.main([str(runs), *arguments]) == 0
    assert table(tmp_path / "out") == [*PROMPTS, PERSON]
    *others, of_person = table(tmp_path / "out", "action")  # a column of persons only
    assert others == ["nan"] * 4 and of_person in ("0.0", "1.0")
    assert table(tmp_path / "out", "kind")[3] == table(tmp_path / "out", "multi_face")[2] == "nan"
    content = json.loads((tmp_path / "out/scorecard.json").read_text())
    assert content["kind"]["mean"]["count"] == 3  # three prompts have known words
    assert content["multi_face"]["mean"]["count"] == 2  # and a mug has no front
    assert content["action"]["mean"]["count"] == 1
    printed = capsys.readouterr().out
    assert "kind, colors, pattern, accessory: no value for 1 of the prompts ('a zebra')" in printed
    assert "multi_face: no value for 2 of the prompts ('a blue mug with white dots'; 'a" in printed


def test_a_run_in_several_folders_is_scored_once(tmp_path, judge, monkeypatch):
    """Also behind links, of which two lead to folders above: without a guard they never end."""
    runs = finished(tmp_path / "runs", PROMPTS[:2])
    links = tmp_path / "links"
    links.mkdir()
    first = runs / "gaussiandreamer/run0"
    for name, where in (("first", first), ("up", links), ("top", tmp_path), ("all", runs)):
        (links / name).symlink_to(where)
    monkeypatch.chdir(tmp_path)
    again = ["runs/gaussiandreamer/run1", str(runs), "runs", "links"]
    assert scorecard.main([*again, "--metrics", "judge", "--judge", judge, "--output", "out"]) == 0
    assert "pattern,accessory\n" in (tmp_path / "out/scorecard.csv").read_text()
    assert sorted(table(tmp_path / "out")) == sorted(PROMPTS[:2])


def test_what_can_not_be_scored_is_named_and_the_others_are_scored(tmp_path, judge, capsys):
    """A damaged file, an export without Gaussians, and a run without a prompt."""
    runs = finished(tmp_path / "runs", [*PROMPTS, ""])
    exports = [runs / f"gaussiandreamer/run{i}/save/it5-export" for i in range(5)]
    plys = [exported / "gaussians.ply" for exported in exports]
    plys[1].write_bytes(plys[1].read_bytes()[:-100])
    write_cloud(str(exports[0] / "gaussians.spz"), read_cloud(str(plys[0])))
    (exports[2] / "model.obj").write_text("v 0 0 0")
    for ply in (plys[0], plys[2]):
        ply.unlink()
    arguments = ["--metrics", "judge", "--judge", judge, "--output", str(tmp_path / "out")]
    assert scorecard.main([str(runs), *arguments]) == 2
    said = capsys.readouterr().err
    assert "3 of the assets can't be scored: " in said and "PLY file" in said
    assert f"{str(exports[2].parents[1])!r}" in said and "has no prompt" in said
    assert table(tmp_path / "out") == [PROMPTS[0], PROMPTS[3]]


def test_clip_of_two_folders_is_compared_by_prompt(tmp_path):
    pytest.importorskip("transformers")
    clip = str(tiny.clip(tmp_path / "clip"))
    first, second = finished(tmp_path / "a", PROMPTS[:2]), finished(tmp_path / "b", PROMPTS[1:3])
    arguments = ["--metrics", "clip,directions", "--clip", clip, "--size", "24"]
    arguments += ["--against", str(second), "--output", str(tmp_path / "out")]
    assert scorecard.main([str(first), *arguments]) == 0
    content = json.loads((tmp_path / "out/scorecard.json").read_text())
    clip_score = content["clip"]
    assert clip_score["difference"]["count"] == 1  # the fox is in both
    assert -100 <= clip_score["mean"]["mean"] <= 100
    assert 0 <= content["wrong_direction"]["against"]["mean"] <= 1


def test_rewards_of_views(tmp_path, monkeypatch):
    pytest.importorskip("transformers")
    monkeypatch.setattr(t3bench, "SIZE", 16)
    folder = str(tiny_image_reward.write(tmp_path / "ir"))
    runs = finished(tmp_path / "runs", PROMPTS[:1])
    arguments = ["--metrics", "imagereward,quality", "--imagereward", folder, "--size", "16"]
    assert scorecard.main([str(runs), *arguments, "--output", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out/scorecard.json").read_text())
    reward, quality = (content[name]["mean"]["mean"] for name in ("imagereward", "quality"))
    assert abs(quality - (20 * reward + 50)) < 40  # of the same cloud, on another scale


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}", "--metrics", "clop"], "clip"),
        (["{}", "--metrics", ","], "--metrics is empty"),
        (["{}", "--metrics", "clip"], "--clip FOLDER"),
        (["{}", "--metrics", "quality"], "--imagereward FOLDER, after `hf download"),
        (["{}", "--metrics", "imagereward", "--imagereward", "no"], "ImageReward.pt is missing"),
        (["{}", "--metrics", "judge", "--judge", "none.safetensors"], "none.safetensors"),
        (["{}", "--metrics", "judge", "--size", "0", "--judge", "{judge}"], "--size: exp"),
        (["{}", "--metrics", "judge", "--size", "64", "--judge", "{judge}"], "--size has no"),
        (["{}/configs", "--metrics", "judge", "--judge", "{judge}"], "holds no finished runs"),
        (["{}", "--metrics", "judge", "--judge", "{judge}", "--output", "{judge}"], "--output"),
    ],
)
def test_wrong_input_is_named(tmp_path, judge, capsys, arguments, message):
    run = finished(tmp_path / "runs", PROMPTS[:1]) / "gaussiandreamer/run0"
    arguments = [a.replace("{judge}", judge).replace("{}", str(run)) for a in arguments]
    assert scorecard.main(arguments) == 2
    assert message in capsys.readouterr().err


def test_intervals_of_many_undefined_and_paired_values():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    found, error = scorecard.bootstrap(values), values.std() / math.sqrt(len(values))
    assert found.mean == pytest.approx(values.mean())
    assert found.low == pytest.approx(values.mean() - 1.96 * error, abs=0.15 * error)
    assert found.high == pytest.approx(values.mean() + 1.96 * error, abs=0.15 * error)
    assert scorecard.bootstrap(np.array([1.0, np.nan, 1.0])) == (1.0, 1.0, 1.0, 2)
    empty = scorecard.bootstrap(np.array([np.nan]))
    assert math.isnan(empty.mean) and empty.count == 0
    means = scorecard.per_prompt(["a", "a", "b", "c"], np.array([0.0, 1.0, 3.0, np.nan]))
    assert means["a"] == 0.5 and means["b"] == 3.0 and math.isnan(means["c"])
    first, second = {"a": 2.0, "b": 5.0, "c": 9.0}, {"b": 4.0, "a": 1.0, "d": 0.0}
    assert scorecard.paired(first, second) == (1.0, 1.0, 1.0, 2)
