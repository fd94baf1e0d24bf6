"""Whole runs of a few steps against a known ground truth."""

import csv
import json
import re

import numpy as np

from tests.training.runs import SMALL, cloud_of, launch, length, mocked_config, run_folder
from threestudio_gaussiandreamer.formats.ply import read_gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh0_to_rgb
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.training import events, held_out, system


def test_training_against_a_known_truth_improves_on_held_out_views(tmp_path, painted_box, capsys):
    assert launch(tmp_path, painted_box, *length(60)) == 0
    metrics = json.loads((run_folder(tmp_path) / "save" / "metrics.json").read_text())
    # 60 steps at 24 pixels give about 4 dB
    assert metrics["result"]["psnr"] > metrics["prior"]["psnr"] + 1.5
    assert metrics["result"]["step"] == 60 and metrics["result"]["gaussians"] == 200
    (exported,) = (run_folder(tmp_path) / "save").glob("it60-export/gaussians.ply")
    colors = sh0_to_rgb(read_gaussians(exported).sh[:, 0])
    assert colors.min() > -1e-6 and colors.max() < 1 + 1e-6
    assert metrics["result"]["out_of_gamut"] == 0
    printed = capsys.readouterr().out
    for said in ("compare.png", "test.mp4", ".ply", "multi-face", "sides look alike"):
        assert said in printed
    logged = run_folder(tmp_path) / "csv_logs" / "version_0" / "metrics.csv"
    (header, *_) = csv.reader(open(logged))
    assert {"loss", "gaussians", "dB", "train/loss_sds", "train/grad_norm"} <= set(header)
    events = tensorboard_events(run_folder(tmp_path))
    logged = [(event.step, round(event.value, 3)) for event in events.Scalars("held_out/psnr")]
    assert logged == [(0, metrics["prior"]["psnr"]), (60, metrics["result"]["psnr"])]
    assert [event.step for event in events.Images("validation/0")] == [60]
    assert events.Images("validation/0")[0].width > events.Images("validation/0")[0].height


def tensorboard_events(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    return EventAccumulator(str(folder / "tb_logs" / "version_0")).Reload()


def test_pictures_are_no_training_time_and_pages_can_be_off(tmp_path, painted_box, monkeypatch):
    clock = np.zeros(2)
    monkeypatch.setattr(held_out, "_now", clock.copy)

    def taking(hours, body):
        return lambda *args: (clock.__iadd__(hours), body(*args))[1]

    slow = (system.GaussianDreamerSystem, "training_step", 1), (events, "save_pictures", 100)
    for owner, name, hours in slow:
        monkeypatch.setattr(owner, name, taking(hours, getattr(owner, name)))
    options = ["trainer.max_steps=2", "trainer.val_check_interval=1", "system.pages=false"]
    assert launch(tmp_path, painted_box, *options, "system.exporter.save_video=false") == 0
    save = run_folder(tmp_path) / "save"
    assert not [*save.rglob("*.html"), *save.rglob("poster.png"), *save.rglob("prior/*.spz")]
    assert json.loads((save / "metrics.json").read_text())["seconds"] == 2


def test_auto_says_what_more_would_gain_and_a_background_is_learned(tmp_path, painted_box, capsys):
    """In each round, and at the end of the run; here without a ground truth."""
    options = ["budget=auto", "min_gaussians=20"]
    options += [f"prune.{x}" for x in "start=2 stop=6 every=2 gain=5.9 likeness=1".split()]
    options = [f"system.geometry.{option}" for option in options]
    options += [f"exp_root_dir={tmp_path}", *length(6)]
    background = {"mode": "learned", "color": [0.5, 0.5, 0.5], "lr": 0.1}
    config = mocked_config(tmp_path, painted_box, background=background)
    assert main(["--config", str(config), "--train", "--gpu", "cpu", *SMALL, *options]) == 0
    said = "".join(capsys.readouterr())
    assert "budget=auto samples once a step, too rarely in 2 steps a round" in said
    rounds = re.findall(r"step (2|4): (\d+) -> (\d+) Gaussians: .* would (gain|lose) \d", said)
    assert len(rounds) == 2 and all(int(now) <= int(before) for _, before, now, _ in rounds)
    assert re.search(rf"{int(rounds[1][2]):,} of [\d,]+ Gaussians: twice as many would gain", said)
    rows = csv.DictReader(open(run_folder(tmp_path) / "csv_logs" / "version_0" / "metrics.csv"))
    assert any(row.get("prune/gain") for row in rows)
    color = cloud_of(run_folder(tmp_path) / "ckpts" / "last.ckpt")["background.logit"].sigmoid()
    assert color[0] > 0.55 and (color[1:] < 0.45).all()  # on its way to the mock's (0.9, 0.2, 0.1)
