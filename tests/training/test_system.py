"""Whole runs of a few steps: with a mock guidance, against a known ground truth, killed and
resumed.
"""

import csv
import json

import numpy as np
import pytest
import torch

from tests.training.runs import (
    DENSIFY,
    PRUNE,
    SMALL,
    cloud_of,
    launch,
    length,
    mocked_config,
    run_folder,
    same,
)
from threestudio_gaussiandreamer.formats.ply import read_gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh0_to_rgb
from threestudio_gaussiandreamer.guidance.picture_bank import MeshTruth
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.training import held_out as evaluate
from threestudio_gaussiandreamer.training import system as system_module
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["system.geometry.prior.path=${system.guidance.mesh}s"], "does not exist"),
        (
            [
                "system.prompt_processor_type=gaussiandreamer-stable-diffusion-prompt-processor",
                f"system.prompt_processor.cache_dir={__file__}/cache",
            ],
            "cache_dir",
        ),
    ],
)
def test_files_and_folders_are_checked_before_any_model_is_loaded(
    tmp_path, painted_box, capsys, monkeypatch, options, said
):
    monkeypatch.setattr(
        GaussianDreamerSystem, "prepare_guidance", lambda self: pytest.fail("a model was loaded")
    )
    assert launch(tmp_path, painted_box, *options) == 2
    assert said in capsys.readouterr().err


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


def test_a_long_run_has_the_pictures_of_its_pool_cast_at_once_and_pages_can_be_switched_off(
    tmp_path, painted_box, monkeypatch
):
    cast = []
    monkeypatch.setattr(
        MeshTruth, "prefetch", lambda self, *views: cast.append((len(views[0]), *views[2:]))
    )
    options = ["data.width=48", "data.height=48", "system.renderer.downsample=2"]
    options += ["trainer.max_steps=3", "system.exporter.save_video=false", "system.pages=false"]
    assert launch(tmp_path, painted_box, *options) == 0
    assert cast == [(12, 24, 24)]
    save = run_folder(tmp_path) / "save"
    assert not [*save.rglob("*.html"), *save.rglob("poster.png"), *save.rglob("prior/*.spz")]


def test_looking_at_pictures_is_no_training_time(tmp_path, painted_box, monkeypatch):
    clock = np.zeros(2)
    monkeypatch.setattr(evaluate, "_now", clock.copy)

    def taking(hours, body):
        return lambda *args: (clock.__iadd__(hours), body(*args))[1]

    for owner, name, hours in (
        (GaussianDreamerSystem, "training_step", 1),
        (system_module, "save_pictures", 100),
    ):
        monkeypatch.setattr(owner, name, taking(hours, getattr(owner, name)))
    options = ["trainer.max_steps=2", "trainer.val_check_interval=1"]
    assert launch(tmp_path, painted_box, *options, "system.exporter.save_video=false") == 0
    assert json.loads((run_folder(tmp_path) / "save" / "metrics.json").read_text())["seconds"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "stop"), [(DENSIFY, 3), (DENSIFY, 4), (PRUNE, 4)])
def test_a_stopped_and_resumed_run_equals_the_run_that_never_stopped(
    tmp_path, painted_box, changes, stop
):
    """Bit for bit: Gaussians, moments, statistics; with stops before, at and after a change of the
    cloud, and more validation.
    """
    options = [*changes, "checkpoint.every_n_train_steps=1"]

    def train(name, steps, val_interval, *more):
        lengths = f"trainer.max_steps={steps}", f"trainer.val_check_interval={val_interval}"
        assert launch(tmp_path / name, painted_box, *options, *lengths, *more) == 0

    train("whole", 9, 9)
    train("parts", stop, 1)
    last = run_folder(tmp_path / "parts") / "ckpts" / "last.ckpt"
    assert changes is DENSIFY or cloud_of(last)["geometry.removal"].any()  # stopped between samples
    train("parts", 9, 2, f"resume={last}")
    whole, parts = (
        torch.load(run_folder(tmp_path / name) / "ckpts" / "last.ckpt", weights_only=True)
        for name in ("whole", "parts")
    )
    assert whole["global_step"] == parts["global_step"] == 9
    count = len(whole["state_dict"]["geometry.means"])
    assert count > 250 if changes is DENSIFY else count == 130
    assert same(whole["state_dict"], parts["state_dict"])
    states = [c["optimizer_states"][0]["state"] for c in (whole, parts)]
    assert all(
        torch.equal(states[0][i][k], states[1][i][k])
        for i in states[0]
        for k in ("exp_avg", "exp_avg_sq", "step")
    )


def test_a_learned_background_learns_and_is_in_the_checkpoint(tmp_path, painted_box):
    background = {"mode": "learned", "color": [0.5, 0.5, 0.5], "lr": 0.1}
    config = mocked_config(tmp_path, painted_box, background=background)
    overrides = [f"exp_root_dir={tmp_path}", *SMALL, *length(20)]
    assert main(["--config", str(config), "--train", "--gpu", "cpu", *overrides]) == 0
    logit = cloud_of(run_folder(tmp_path) / "ckpts" / "last.ckpt")["background.logit"]
    color = torch.sigmoid(logit)  # on its way from grey to the mock's (0.9, 0.2, 0.1)
    assert color[0] > 0.7 and color[1] < 0.35 and color[2] < 0.3
