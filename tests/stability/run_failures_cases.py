"""Helpers of the tests of failing runs."""

import torch

EVERY_STEP = ["checkpoint.every_n_train_steps=1", "trainer.max_steps=5"]


# ---- writing checkpoints -------------------------------------------------------------------------


def content(step: int, size: int = 20_000) -> dict:
    return {
        "state_dict": {"means": torch.arange(float(size)) + step},
        "epoch": 0,
        "global_step": step,
    }
