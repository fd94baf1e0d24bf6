"""Whole runs of a few steps against a known ground truth."""

import csv
import json

import numpy as np

from tests.training.runs import launch, length, run_folder
from threestudio_gaussiandreamer.formats.ply import read_gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh0_to_rgb
from threestudio_gaussiandreamer.training import events, held_out
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem


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
    """Return the scalars and images that a run has written for TensorBoard."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    return EventAccumulator(str(folder / "tb_logs" / "version_0")).Reload()


def test_looking_at_pictures_is_no_training_time_and_pages_can_be_switched_off(
    tmp_path, painted_box, monkeypatch
):
    clock = np.zeros(2)
    monkeypatch.setattr(held_out, "_now", clock.copy)

    def taking(hours, body):
        return lambda *args: (clock.__iadd__(hours), body(*args))[1]

    for owner, name, hours in (
        (GaussianDreamerSystem, "training_step", 1),
        (events, "save_pictures", 100),
    ):
        monkeypatch.setattr(owner, name, taking(hours, getattr(owner, name)))
    options = ["trainer.max_steps=2", "trainer.val_check_interval=1", "system.pages=false"]
    assert launch(tmp_path, painted_box, *options, "system.exporter.save_video=false") == 0
    save = run_folder(tmp_path) / "save"
    assert not [*save.rglob("*.html"), *save.rglob("poster.png"), *save.rglob("prior/*.spz")]
    assert json.loads((save / "metrics.json").read_text())["seconds"] == 2
