"""Checkpoints of the toybox's stages: damage, other files and versions, a full disk."""

import pytest
import torch

from tests.toybox.helpers import copied, training
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
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
    with pytest.raises(UserError, match="judge.pt isn't a checkpoint of this stage"):
        training(tmp_path / "run", "judge")


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
