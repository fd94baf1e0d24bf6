"""The scorecard of finished runs: rows, intervals, comparisons, and messages for wrong input."""

import csv
import json

import pytest
import torch

from tests.evaluation.clip_similarity_cases import blob, save
from tests.helpers import tiny_3d_models as tiny
from tests.helpers import tiny_image_reward
from threestudio_gaussiandreamer.evaluation import t3bench
from threestudio_gaussiandreamer.evaluation.scorecard import main
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud, write_cloud
from threestudio_gaussiandreamer.toybox import export, models

PROMPTS = ("a red fox", "a red fox", "a blue mug with white dots", "a zebra")


def finished(folder, prompts):
    """Folders of finished runs with one cloud each."""
    for number, prompt in enumerate(prompts):
        run = folder / "gaussiandreamer" / f"run{number}"
        save(run / "save/it5-export/gaussians.ply", blob(seed=number))
        (run / "configs").mkdir()
        config = {"system": {"prompt_processor": {"prompt": prompt}}}
        (run / "configs/parsed.yaml").write_text(json.dumps(config))
    return folder


@pytest.fixture
def judge(tmp_path):
    torch.manual_seed(0)
    export.write_weights(tmp_path / "judge.safetensors", models.Judge().state_dict())
    return str(tmp_path / "judge.safetensors")


def test_rows_and_intervals_over_prompts(tmp_path, judge, capsys):
    runs = finished(tmp_path / "runs", PROMPTS)
    arguments = ["--metrics", "judge,janus", "--judge", judge, "--output", str(tmp_path / "out")]
    assert main([str(runs), *arguments]) == 0
    with open(tmp_path / "out/scorecard.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["prompt"] for row in rows] == list(PROMPTS)
    assert rows[3]["kind"] == "nan" and rows[2]["multi_face"] == "nan"
    content = json.loads((tmp_path / "out/scorecard.json").read_text())
    assert content["kind"]["mean"]["count"] == 2  # two prompts have known words
    assert content["multi_face"]["mean"]["count"] == 1  # and a mug has no front
    printed = capsys.readouterr().out
    assert (
        "kind, colors, pattern, accessory: no value for 1 of the prompts ('a zebra'): " in printed
    )
    assert "multi_face: no value for 2 of the prompts ('a blue mug with white dots'; 'a" in printed


def test_links_to_runs_and_to_folders_above_are_followed_once(tmp_path, judge):
    runs = finished(tmp_path / "runs", PROMPTS[:2])
    folder = tmp_path / "links"
    folder.mkdir()
    (folder / "first").symlink_to(runs / "gaussiandreamer/run0")
    (folder / "up").symlink_to(tmp_path / "links")
    arguments = ["--metrics", "judge", "--judge", judge, "--output", str(tmp_path / "out")]
    assert main([str(folder), *arguments]) == 0
    assert len((tmp_path / "out/scorecard.csv").read_text().splitlines()) == 2


def test_a_damaged_asset_is_named_and_the_others_are_scored(tmp_path, judge, capsys):
    runs = finished(tmp_path / "runs", PROMPTS)
    ply = runs / "gaussiandreamer/run1/save/it5-export/gaussians.ply"
    ply.write_bytes(ply.read_bytes()[:-100])
    arguments = ["--metrics", "judge", "--judge", judge, "--output", str(tmp_path / "out")]
    assert main([str(runs), *arguments]) == 2
    assert "1 of the assets can't be scored: PLY file" in capsys.readouterr().err
    with open(tmp_path / "out/scorecard.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(PROMPTS) - 1


def test_runs_without_a_ply_are_scored_or_named(tmp_path, judge, capsys):
    runs = finished(tmp_path / "runs", PROMPTS[:3])
    exports = [runs / f"gaussiandreamer/run{i}/save/it5-export" for i in range(3)]
    write_cloud(str(exports[0] / "gaussians.spz"), read_cloud(str(exports[0] / "gaussians.ply")))
    (exports[1] / "model.obj").write_text("v 0 0 0")
    for exported in exports[:2]:
        (exported / "gaussians.ply").unlink()
    arguments = ["--metrics", "judge", "--judge", judge, "--output", str(tmp_path / "out")]
    assert main([str(runs), *arguments]) == 2
    said = capsys.readouterr().err
    assert "1 of the assets can't be scored" in said and f"{str(exports[1].parents[1])!r}" in said
    with open(tmp_path / "out/scorecard.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["prompt"] for row in rows] == [PROMPTS[0], PROMPTS[2]]


def test_a_run_in_several_folders_is_scored_once(tmp_path, judge, monkeypatch):
    runs = finished(tmp_path / "runs", PROMPTS[:2])
    (tmp_path / "link").symlink_to(runs)
    monkeypatch.chdir(tmp_path)
    again = ["runs/gaussiandreamer/run1", str(runs), "runs", "link"]
    assert main([*again, "--metrics", "judge", "--judge", judge, "--output", "out"]) == 0
    with open("out/scorecard.csv", newline="") as file:
        assert sorted(row["prompt"] for row in csv.DictReader(file)) == sorted(PROMPTS[:2])


def test_clip_of_two_folders_is_compared_by_prompt(tmp_path):
    pytest.importorskip("transformers")
    clip = str(tiny.clip(tmp_path / "clip"))
    first, second = finished(tmp_path / "a", PROMPTS[:2]), finished(tmp_path / "b", PROMPTS[1:3])
    arguments = ["--metrics", "clip,directions", "--clip", clip, "--size", "24"]
    arguments += ["--against", str(second), "--output", str(tmp_path / "out")]
    assert main([str(first), *arguments]) == 0
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
    assert main([str(runs), *arguments, "--output", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out/scorecard.json").read_text())
    reward, quality = (content[name]["mean"]["mean"] for name in ("imagereward", "quality"))
    assert abs(quality - (20 * reward + 50)) < 40  # of the same cloud, on another scale


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}", "--metrics", "clop"], "clip"),
        (["{}", "--metrics", "alignment"], "GPT-4"),
        (["{}", "--metrics", ","], "--metrics is empty"),
        (["{}", "--metrics", "clip"], "--clip FOLDER"),
        (["{}", "--metrics", "quality"], "--imagereward FOLDER, after `hf download"),
        (["{}", "--metrics", "imagereward", "--imagereward", "no"], "ImageReward.pt is missing"),
        (["{}", "--metrics", "judge", "--judge", "none.safetensors"], "none.safetensors"),
        (["{}", "--metrics", "judge", "--size", "0", "--judge", "{judge}"], "--size 0"),
        (
            ["{}", "--metrics", "judge", "--size", "64", "--judge", "{judge}"],
            "--size has no",
        ),
        (["{}/no", "--metrics", "judge", "--judge", "{judge}"], "no folder"),
        (["{}/configs", "--metrics", "judge", "--judge", "{judge}"], "holds no finished run"),
        (["{}", "--metrics", "judge", "--judge", "{judge}", "--output", "{judge}"], "--output"),
    ],
)
def test_wrong_input_is_named(tmp_path, judge, capsys, arguments, message):
    run = finished(tmp_path / "runs", PROMPTS[:1]) / "gaussiandreamer/run0"
    arguments = [a.replace("{judge}", judge).replace("{}", str(run)) for a in arguments]
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_a_run_without_a_prompt_is_named(tmp_path, judge, capsys):
    run = finished(tmp_path / "runs", [""])
    assert main([str(run), "--metrics", "judge", "--judge", judge]) == 2
    assert "has no prompt" in capsys.readouterr().err


def test_a_run_without_a_prompt_is_named_after_the_others_are_scored(tmp_path, judge, capsys):
    runs = finished(tmp_path / "runs", ["", PROMPTS[0]])
    output = tmp_path / "out"
    arguments = ["--metrics", "judge", "--judge", judge, "--output", str(output)]
    assert main([str(runs), *arguments]) == 2
    assert "1 of the assets can't be scored" in (error := capsys.readouterr().err)
    assert "run0" in error and "has no prompt" in error
    with open(output / "scorecard.csv", newline="") as file:
        assert [row["prompt"] for row in csv.DictReader(file)] == [PROMPTS[0]]
