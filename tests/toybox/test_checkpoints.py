"""Checkpoints of the toybox's stages: damage, other files and versions, a full disk."""

import pytest
import torch

from tests.toybox.helpers import copied, training
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
from threestudio_gaussiandreamer.core.errors import UserError

pytestmark = pytest.mark.usefixtures("small_world")


def test_damaged_and_other_files_and_a_full_disk_are_messages(folder, tmp_path, monkeypatch):
    run = training(copied(folder, tmp_path / "run"), "judge")
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
