"""Damaged checkpoints are rejected, or the previous one is used."""

import random
from pathlib import Path

import pytest
import torch

from tests.stability.rows import row
from tests.stability.run_failures_cases import EVERY_STEP, content
from tests.stability.small_runs import Ended, launch, require_equal_ends
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.checkpoint_file import (
    load_file,
    save_file,
)
from threestudio_gaussiandreamer.core.errors import UserError

register_parts()


# ---- damaged checkpoints -------------------------------------------------------------------------


def damaged(path: Path, how: str, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    if how == "truncated":
        path.write_bytes(data[: rng.randrange(len(data))])
    else:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)


@row("A5", "Corrupted checkpoint")
@pytest.mark.parametrize("how, times", [("truncated", 50), ("flipped", 200)])
def test_no_damaged_byte_is_ever_loaded(how, times, tmp_path, measured):
    path, rng, refused = tmp_path / "a.ckpt", random.Random(0), 0
    save_file(path, content(7))
    good = path.read_bytes()
    for _ in range(times):
        path.write_bytes(good)
        damaged(path, how, rng)
        with pytest.raises(UserError, match=str(path)):
            load_file(path)
        refused += 1
    measured(refused - times, f"of {times}", what=f"{how} and loaded", at_most=0)


@pytest.fixture
def stopped(tmp_path) -> Ended:
    """Return a run of three steps whose last checkpoint and its copy are damaged; the previous one
    is intact.
    """
    ended = launch(tmp_path, "checkpoint.every_n_train_steps=1", "trainer.max_steps=3")
    assert ended.code == 0, ended.err
    for name in ("last.ckpt", "epoch=0-step=3.ckpt"):
        damaged(ended.last.with_name(name), "flipped", random.Random(1))
    return ended


@row("A5", "Corrupted checkpoint")
def test_a_damaged_checkpoint_that_was_asked_for_is_refused(stopped, tmp_path, measured):
    ended = launch(tmp_path, *EVERY_STEP, f"resume={stopped.last}")
    assert (
        ended.code == 2
        and str(stopped.last) in ended.err
        and "checksum" in ended.err
        and "Traceback" not in ended.err
    )
    assert "last-prev.ckpt" in ended.err  # what could be taken instead, though only the user may
    measured("refused, its path named")


@row("A5", "Corrupted checkpoint")
def test_resume_auto_falls_back_to_the_previous_checkpoint_with_a_message(
    stopped, whole, tmp_path, measured
):
    ended = launch(tmp_path, *EVERY_STEP, "resume=auto")
    assert ended.code == 0, ended.err
    assert (
        "resuming from" in ended.err
        and "step=2.ckpt" in ended.err.split("resuming from")[1]
        or "last-prev.ckpt" in ended.err
    )
    assert ended.err.count("is damaged") == 2  # what was passed over is named
    require_equal_ends(measured, whole, ended, "different after resume=auto")


@row("A5", "Corrupted checkpoint")
def test_resume_auto_without_a_checkpoint_starts_from_the_prior_with_a_message(tmp_path, measured):
    ended = launch(tmp_path, "trainer.max_steps=1", "resume=auto")
    assert ended.code == 0
    assert "no checkpoint of" in ended.err and "starting from the prior" in ended.err
    measured("the chosen file is logged")


INCONSISTENT = {
    "without loops": (lambda c: c.pop("loops"), "it has no loops"),
    "without optimizer_states": (lambda c: c.pop("optimizer_states"), "it has no optimizer_states"),
    "0-d means": (
        lambda c: c["state_dict"].update({"geometry.means": torch.tensor(1.0)}),
        "geometry.means",
    ),
    "means (N, 2)": (
        lambda c: c["state_dict"].update({"geometry.means": torch.zeros(120, 2)}),
        "geometry.means",
    ),
    "a mean more": (
        lambda c: c["state_dict"].update({"geometry.means": torch.zeros(121, 3)}),
        "geometry.log_scales",
    ),
    "means as a list": (
        lambda c: c["state_dict"].update({"geometry.means": [1.0, 2.0]}),
        "geometry.means",
    ),
    "no means": (lambda c: c["state_dict"].pop("geometry.means"), "geometry.means"),
    "moments of another size": (
        lambda c: c["optimizer_states"][0]["param_groups"].pop(),
        "another configuration",
    ),
    "a step that is a word": (
        lambda c: c.update(global_step="three"),
        "global_step is of type str",
    ),
}


@row("A5", "Corrupted checkpoint")
@pytest.mark.parametrize("what", INCONSISTENT)
def test_an_inconsistent_checkpoint_is_named(what, whole, tmp_path, measured):
    """Its checksum is valid, but its content is not: untrained at step 0, or incomplete."""
    change, message = INCONSISTENT[what]
    checkpoint = whole.checkpoint()
    change(checkpoint)
    save_file(tmp_path / "made.ckpt", checkpoint)
    ended = launch(
        tmp_path / "run", *EVERY_STEP, "trainer.max_steps=9", f"resume={tmp_path}/made.ckpt"
    )
    assert ended.code == 2 and "Traceback" not in ended.err, ended.err
    assert "made.ckpt" in ended.err and message in ended.err, ended.err
    assert not (tmp_path / "run").exists()
    measured("named error, nothing written")
