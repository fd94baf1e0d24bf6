"""The command that trains the toybox's stages, killed and started again."""

import multiprocessing
import time
from pathlib import Path

import pytest
import torch

from threestudio_gaussiandreamer.core.checkpoint_file import load_file
from threestudio_gaussiandreamer.core.devices import torch_threads
from threestudio_gaussiandreamer.toybox import clip_stage, loop, train


@pytest.mark.slow
def test_after_kills_the_same_command_gives_what_an_uninterrupted_one_gives(tmp_path, monkeypatch):
    """The stage of prompts, which needs no pictures; it saves after each of its sixteen steps. What
    isn't killed runs in this process.
    """
    end = ["--stages", "text", "--images", "512", "--batch", "32"]
    start = multiprocessing.get_context("forkserver")  # one process imports for both
    start.set_forkserver_preload([train.__name__, "transformers.models.clip.modeling_clip"])
    for seen in (32, 256):
        process = start.Process(
            target=train_and_save_each_step, args=([str(tmp_path / "killed"), *end],)
        )
        process.start()
        while seen_in(tmp_path / "killed") < seen:
            assert process.is_alive()
            time.sleep(0.1)  # reading the checkpoint takes processor time from the training
        process.kill()
        process.join()
    monkeypatch.setattr(clip_stage, "HELD_OUT", 4)  # its measurement isn't looked at
    for name in ("killed", "whole"):
        with torch_threads(1):
            assert train.main([str(tmp_path / name), *end]) == 0
    killed, whole = (loop.averaged_weights(tmp_path / name, "text") for name in ("killed", "whole"))
    assert killed.keys() == whole.keys()
    assert all(torch.equal(killed[key], whole[key]) for key in whole)


def train_and_save_each_step(arguments: list[str]) -> None:
    loop.SAVE_SECONDS = 0
    torch.set_num_threads(1)
    train.main(arguments)


def seen_in(folder: Path) -> int:
    """Return how many pictures the stage of prompts has seen at its last checkpoint."""
    path = folder / "text.pt"
    return load_file(path)["images"] if path.is_file() else 0
