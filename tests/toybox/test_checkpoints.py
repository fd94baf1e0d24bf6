"""Checkpoints of the toybox's stages: damage, other files and versions, a full disk."""

import pytest
import torch

from tests.toybox.helpers import copied, training
from threestudio_gaussiandreamer.core.checkpoint_file import load_file, save_file
from threestudio_gaussiandreamer.core.errors import UserError

pytestmark = pytest.mark.usefixtures("small_world")


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
