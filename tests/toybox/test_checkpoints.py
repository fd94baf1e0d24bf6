"""Checkpoints of the toybox's stages: damage, other files and versions, kills, a full disk."""

import multiprocessing
import time
from pathlib import Path

import pytest
import torch

from tests.helpers.threads import torch_threads
from tests.toybox.helpers import copied, training
from threestudio_gaussiandreamer.core.checkpoint_file import load_file, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.toybox import checkpoints, loop, models, text_stage, train

pytestmark = pytest.mark.usefixtures("small_world")
FULL_SIZES = {
    (module, name): getattr(module, name)
    for module, name in ((models, "TEXT_LAYERS"), (models, "VISION_LAYERS"), (loop, "WARMUP"))
}
"""Before a fixture makes them smaller."""


def test_a_damaged_checkpoint_is_refused(folder, tmp_path):
    run = training(copied(folder, tmp_path / "run"), "judge")
    run.run(4)
    content = bytearray(run.path.read_bytes())
    content[len(content) // 2] ^= 255
    run.path.write_bytes(content)
    with pytest.raises(UserError, match="judge.pt"):
        training(tmp_path / "run", "judge")


def test_a_file_of_another_sort_is_named(folder, tmp_path):
    run = training(copied(folder, tmp_path / "run"), "judge")
    save_file(run.path, {"a": torch.zeros(1)})
    with pytest.raises(UserError, match="judge.pt isn't a checkpoint of .*: it has no constants"):
        training(tmp_path / "run", "judge")


def test_another_version_of_torch_is_told(folder, tmp_path, caplog):
    caplog.set_level("INFO")
    run = training(copied(folder, tmp_path / "run"), "judge")
    run.run(4)
    training(tmp_path / "run", "judge")
    assert "torch" not in caplog.text
    save_file(run.path, load_file(run.path) | {"torch": "1.0"})
    resumed = training(tmp_path / "run", "judge")
    assert f"begun with torch 1.0, continued with {torch.__version__}" in caplog.text
    assert resumed.run(8).images == 8


def test_a_full_disk_is_reported_and_leaves_the_earlier_checkpoint(folder, tmp_path, monkeypatch):
    run = training(copied(folder, tmp_path / "run"), "judge")
    run.run(4)
    before = run.path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(UserError, match="No space left"):
        run.run(8)
    assert run.path.read_bytes() == before


@pytest.mark.slow
def test_after_kills_the_same_command_gives_what_an_uninterrupted_one_gives(tmp_path, monkeypatch):
    """The stage of prompts, which needs no pictures; it saves after each of its sixteen steps. What
    isn't killed runs in this process, with the sizes of the processes that are killed.
    """
    for module, name in FULL_SIZES:
        monkeypatch.setattr(module, name, FULL_SIZES[module, name])
    end = ["--stages", "text", "--images", "512", "--batch", "32", "--save-minutes", "0"]
    start = multiprocessing.get_context("forkserver")  # one process imports for both
    start.set_forkserver_preload([train.__name__, "transformers.models.clip.modeling_clip"])
    for seen in (32, 256):
        process = start.Process(
            target=train.main, args=([str(tmp_path / "killed"), *end, "--threads", "1"],)
        )
        process.start()
        while seen_in(tmp_path / "killed") < seen:
            assert process.is_alive()
            time.sleep(0.1)  # reading the checkpoint takes processor time from the training
        process.kill()
        process.join()
    monkeypatch.setattr(text_stage, "HELD_OUT", 4)  # its measurement isn't looked at
    for name in ("killed", "whole"):
        with torch_threads(1):
            assert train.main([str(tmp_path / name), *end]) == 0
    killed, whole = (
        checkpoints.averaged_weights(tmp_path / name, "text") for name in ("killed", "whole")
    )
    assert killed.keys() == whole.keys()
    assert all(torch.equal(killed[key], whole[key]) for key in whole)


def seen_in(folder: Path) -> int:
    """Return how many pictures the stage of prompts has seen at its last checkpoint."""
    path = folder / "text.pt"
    return load_file(path)["images"] if path.is_file() else 0


def test_stages_that_need_others_name_them(tmp_path):
    with pytest.raises(UserError, match="train the stage 'text' first"):
        training(tmp_path, "unet")


def test_a_unet_of_another_text_encoder_is_refused(folder, tmp_path):
    place = copied(folder, tmp_path / "run")
    training(place, "unet").run(4)
    (place / "text.pt").unlink()
    other = training(place, "text", seed=1)
    other.train_step(next(other.stage.batches(0)))
    other.save()
    with pytest.raises(UserError, match="trained with another text"):
        training(place, "unet")
