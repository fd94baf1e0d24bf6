"""Every stage of the toybox's training learns, resumes exactly, and reports errors."""

import itertools
import shutil
import signal

import numpy as np
import pytest
import torch

from tests.toybox.helpers import options, training
from threestudio_gaussiandreamer.core.checkpoint_file import load_file, save_file
from threestudio_gaussiandreamer.core.devices import torch_threads
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.run_folder import claim
from threestudio_gaussiandreamer.toybox import judge_stage, loop
from threestudio_gaussiandreamer.toybox.loop import averaged_weights
from threestudio_gaussiandreamer.toybox.train import STAGES, main, render_shards

pytestmark = pytest.mark.usefixtures("small_world")


def weights(run: loop.Training) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in run.ema.state_dict().items()}


def stop_after(run: loop.Training, steps: int) -> None:
    """Stop the training by a signal after ``steps`` steps."""
    train_step, count = run.train_step, itertools.count(1)

    def counted(batch):
        metrics = train_step(batch)
        run.signum = signal.SIGINT if next(count) == steps else 0
        return metrics

    run.train_step = counted


@pytest.mark.parametrize("name", STAGES)
def test_resuming_gives_what_an_uninterrupted_training_gives(folder, name, tmp_path):
    whole, parts = (
        shutil.copytree(folder, tmp_path / "whole"),
        shutil.copytree(folder, tmp_path / "parts"),
    )
    torch.seed()  # random weights are a function of the seed, whatever the process drew before
    uninterrupted = training(whole, name)
    uninterrupted.run(uninterrupted.progress.images + 8)
    for step in (1, 2):
        torch.seed()
        run = training(parts, name)
        stop_after(run, step)
        run.run(uninterrupted.progress.images)
    assert run.progress.images == uninterrupted.progress.images
    for key, value in weights(uninterrupted).items():
        assert torch.equal(value, weights(run)[key]), key
    losses = [[row["loss"] for row in r.progress.history] for r in (uninterrupted, run)]
    assert losses[0] == losses[1]
    run.target = 10**9  # not yet decaying
    batch, losses = next(run.stage.batches(0)), []
    for _ in range(12):  # it learns one batch
        run.progress.step = 1  # the same learning rate each time
        losses.append(float(run.train_step(batch)["loss"]))
    assert losses[-1] < 0.97 * losses[0]


@pytest.mark.parametrize("name", [name for name in STAGES if name not in ("points", "motion")])
def test_a_stage_is_measured_on_withheld_objects(folder, name):
    stage = STAGES[name](options(folder))
    numbers = stage.evaluate(stage.model.eval())
    assert numbers and all(np.isfinite(value) for value in numbers.values())
    if name == "judge":  # on both sorts of pictures
        cast, gaussians = stage.held_out()
        assert torch.equal(cast.labels, gaussians.labels)
        assert not torch.equal(cast.images, gaussians.images)


def test_a_stop_signal_saves_and_stops_and_no_other_stage_begins(tmp_path, monkeypatch, capsys):
    number, earlier = signal.SIGHUP, signal.getsignal(signal.SIGHUP)
    step = loop.Training.train_step

    def interrupted(run, batch):
        signal.raise_signal(number)
        return step(run, batch)

    monkeypatch.setattr(loop.Training, "train_step", interrupted)
    monkeypatch.setattr(loop.Training, "_measure", lambda run: None)
    options = ["--images", "1000", "--batch", "4", "--pool", "1", "--stages", "text", "clip"]
    assert main([str(tmp_path), *options]) == 129 and capsys.readouterr().err == "stopped\n"
    assert load_file(tmp_path / "text.pt")["images"] == 4 and not (tmp_path / "clip.pt").exists()
    assert signal.getsignal(number) == earlier


def test_a_gradient_that_is_not_finite_stops_before_it_is_saved(folder, tmp_path):
    run = training(shutil.copytree(folder, tmp_path / "run"), "judge")
    run.run(4)
    before = run.path.read_bytes()
    loss = run.stage.loss

    def broken(model, batch):
        value, metrics = loss(model, batch)
        return value * float("nan"), metrics

    run.stage.loss = broken
    with pytest.raises(UserError, match="gradient of step 1 isn't finite"):
        run.run(8)
    assert run.path.read_bytes() == before


def test_a_time_limit_ends_a_stage_and_lowers_the_rate_before(folder, tmp_path):
    run = training(shutil.copytree(folder, tmp_path / "run"), "judge")
    rates = []

    def step(batch):
        rates.append(loop.rate_factor(loop.WARMUP, run.done))
        run.progress.seconds += 1e5  # beside which those of a busy machine are few
        return {"loss": torch.zeros(())}

    run.train_step = step
    run.run(seconds=1e6)
    assert len(rates) == 10 and rates[0] == 1 and 0 < rates[9] < rates[8] < 1
    rows = (folder / "clip.csv").read_text().splitlines()
    assert rows[0].startswith("images,seconds,loss") and len(rows) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "FOLDER: the folder"),
        ("--stages unett", "did you mean 'unet'"),
        ("--pool -3", "--pool -3: expected a number from 1"),
        ("--device cuda", "unknown device 'cuda'"),
        ("--device cpuu", "unknown device 'cpuu': did you mean 'cpu'"),
        ("--minutes nan", "--minutes nan: expected a number from"),
        ("--seed 1000", "--seed 1000: expected a number from 0 to 999"),
    ],
)
def test_bad_options_are_one_message(tmp_path, capsys, arguments, message):
    (tmp_path / "file").touch()
    assert main([str(tmp_path / "file" / "run"), *arguments.split()]) == 2
    assert message in capsys.readouterr().err


def test_a_stage_is_trained_by_one_process_at_a_time(tmp_path, capsys):
    claimed = claim(tmp_path / "locks" / "judge")
    assert main([str(tmp_path), "--stages", "judge"]) == 2 and not (tmp_path / "judge.pt").exists()
    assert "another process trains the stage 'judge'" in capsys.readouterr().err
    claimed.release()


@pytest.mark.slow  # starts processes
def test_worker_processes_make_the_same_shards_and_batches(folder, tmp_path):
    place = loop.Options(folder=tmp_path, pool=2)
    sorts = place.shards, *judge_stage.judge_shards(place)
    render_shards(sorts, count=2, workers=1)
    assert set(place.shards.folder.iterdir()) == {one.path(i) for one in sorts for i in (0, 1)}
    for one in sorts:
        assert np.array_equal(one.get(1).rgba, one.make(1).rgba)
    here, there = (STAGES["judge"](options(folder, workers=workers)) for workers in (0, 1))
    pairs = zip(here.batches(3), there.batches(3), strict=True)
    with torch_threads(1):  # as in the worker processes; sums are rounded otherwise
        for one, other in itertools.islice(pairs, 3):
            torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_the_judge_has_data_of_its_own(tmp_path):
    """Its seeds are no other stage's, and most of its batches show Gaussians."""
    there = loop.Options(folder=tmp_path, seed=3, pool=1)
    casts, splats = judge_stage.judge_shards(there)
    assert len({there.shards.seed, casts.seed, splats.seed}) == 3
    data = STAGES["judge"](there).data()
    first, second, _ = data.args
    for step, (own, place) in enumerate([(first, 0), (second, 0), (second, 1)]):
        assert torch.equal(data(step).images, own(place).images)
    paths = [part.shards.path(0) for part in (first, second)]
    assert paths == [casts.path(0), splats.path(0)]
    assert torch.equal(data(judge_stage.CAST_EVERY).images, first(1).images)


@pytest.mark.parametrize(
    ("name", "user", "prefix", "free"),
    [
        ("text", "clip", "text_projection.", "heads."),
        ("autoencoder", "unet", "encoder.", "decoder."),
    ],
)
def test_networks_that_others_depend_on_are_frozen(folder, tmp_path, name, user, prefix, free):
    place = shutil.copytree(folder, tmp_path / "run")
    training(place, user).run(4)
    before = averaged_weights(place, name)
    run = training(place, name)
    run.run(run.progress.images + 8)
    after = averaged_weights(place, name)
    assert all(torch.equal(before[key], after[key]) for key in before if key.startswith(prefix))
    assert any(not torch.equal(before[key], after[key]) for key in before if key.startswith(free))
    training(place, user)  # which would be refused if its text encoder or its latents had changed


def test_damaged_and_other_files_and_a_full_disk_are_messages(folder, tmp_path, monkeypatch):
    run = training(shutil.copytree(folder, tmp_path / "run"), "judge")
    run.run(4)
    before = run.path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full)
        with pytest.raises(UserError, match="No space left"):
            run.run(8)
    assert run.path.read_bytes() == before
    damaged = bytearray(before)
    damaged[len(damaged) // 2] ^= 255
    run.path.write_bytes(damaged)
    with pytest.raises(UserError, match="judge.pt"):
        training(tmp_path / "run", "judge")
    save_file(run.path, {"a": torch.zeros(1)})
    with pytest.raises(UserError, match="judge.pt isn't a checkpoint of this stage"):
        training(tmp_path / "run", "judge")
    with pytest.raises(UserError, match="train the stage 'text' first"):
        training(tmp_path, "unet")
