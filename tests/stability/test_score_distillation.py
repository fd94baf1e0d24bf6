"""A4: score distillation. Non-finite scores, mixed precision, schedules, resuming."""

import math
import random

import numpy as np
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision

from tests.helpers.pixel_guidance import TowardsGrey
from tests.stability.rows import row
from tests.stability.small_runs import Ended, launch, require_equal_ends
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.host_copies import HostCopy
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.host import C, register
from threestudio_gaussiandreamer.launch import run
from threestudio_gaussiandreamer.launch.config_check import check_part
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

register_parts()


# ---- scores that aren't finite -------------------------------------------------------------------


@register("stability-corrupted-guidance")
class CorruptedScore(TowardsGrey):
    """Replace the score of some items, at the steps in ``corrupted``, by a value."""

    corrupted: dict[int, dict[int, float]] = {}

    def predict(self, z, t, condition):
        eps, _ = super().predict(z, t, condition)
        for item, value in self.corrupted.get(self.step, {}).items():
            eps[item] = value
        return eps, None


def gradient(corrupted):
    guidance = CorruptedScore({"guidance_scale": 1.0})
    guidance.corrupted = {0: corrupted}
    rgb = torch.rand(4, 8, 8, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    out = guidance(rgb)
    out["loss_sds"].backward()
    return rgb.grad, out


@row("A4", "fp16 overflow in VAE/UNet")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("items", [(0,), (1, 3), (0, 1, 2, 3)])
def test_bad_items_are_masked_and_the_others_keep_every_bit(items, value, measured):
    whole, _ = gradient({})
    masked, out = gradient(dict.fromkeys(items, value))
    others = [i for i in range(4) if i not in items]
    assert (
        out["bad_items"] == len(items)
        and (masked[list(items)] == 0).all()
        and out["loss_sds"].isfinite()
    )
    measured(
        (masked[others] != whole[others]).sum(), what="changed numbers of other items", at_most=0
    )


CORRUPTED = (
    "system.guidance_type=stability-corrupted-guidance",
    "system.geometry.prior.path=toy.glb",
)


@row("A4", "fp16 overflow in VAE/UNet")
def test_bad_steps_are_counted_and_the_tenth_in_a_row_ends_the_run(tmp_path, monkeypatch, measured):
    """One bad item in steps 1 and 3, then both from step 5 on: steps 5 to 14 are ten in a row."""
    bad = {
        1: {0: math.nan},
        3: {1: math.inf},
        **{step: {0: math.nan, 1: math.nan} for step in range(5, 50)},
    }
    monkeypatch.setattr(CorruptedScore, "corrupted", bad)
    ended = launch(
        tmp_path, *CORRUPTED, "trainer.max_steps=50", "checkpoint.every_n_train_steps=14"
    )
    assert (
        ended.code == 2
        and "NaN or infinity in 10 steps in a row (step 14" in ended.err
        and "Traceback" not in ended.err
    )
    assert all(
        parameter.isfinite().all() for parameter in ended.checkpoint()["state_dict"].values()
    )
    logged = ended.logged("train/bad_items")
    assert logged[:6] == [0, 1, 0, 1, 0, 2], logged
    measured("counted in the log; named error after 10")


@row("A4", "fp16 overflow in VAE/UNet")
@pytest.mark.parametrize("every, steps", [(14, 14), (100, 16)], ids=["checkpoint", "end"])
def test_bad_steps_end_the_run_also_if_they_are_known_late(
    tmp_path, monkeypatch, measured, every, steps
):
    """As on a GPU, where numbers are read when they have arrived: here not before they must be."""
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    bad = {step: {0: math.nan} for step in range(3, 50)}
    monkeypatch.setattr(CorruptedScore, "corrupted", bad)
    options = ["trainer.max_steps=16", f"checkpoint.every_n_train_steps={every}"]
    ended = launch(tmp_path, *CORRUPTED, *options)
    assert ended.code == 2 and "NaN or infinity in 10 steps in a row (step 12" in ended.err
    logged = ended.logged("train/bad_items")
    assert logged == [0] * 3 + [1] * (steps - 3), logged
    measured("named error, and all steps in the log")


# ---- mixed precision -----------------------------------------------------------------------------


def scaled_run(folder, monkeypatch, scale, *options) -> Ended:
    """Run with Lightning's 16-mixed and this loss scale; on a CPU float16 needs an
    explicit scaler.
    """
    plugin = MixedPrecision("16-mixed", "cpu", scaler=torch.amp.GradScaler("cpu", init_scale=scale))
    build = run.build

    def with_scaler(section, owner, arguments):
        arguments = {name: value for name, value in arguments.items() if name != "precision"}
        return build(section, owner, arguments | {"plugins": [*arguments["plugins"], plugin]})

    with monkeypatch.context() as patch:
        patch.setattr(run, "build", with_scaler)
        return launch(folder, *options)


@pytest.fixture(scope="module")
def three_steps(tmp_path_factory) -> Ended:
    ended = launch(tmp_path_factory.mktemp("float32"), "trainer.max_steps=3")
    assert ended.code == 0, ended.err
    return ended


@row("A4", "GradScaler")
@pytest.mark.parametrize("scale", [1.0, 2.0**8, 2.0**16, 2.0**24])
def test_any_loss_scale_trains_the_same_bits_as_float32(
    scale, three_steps, tmp_path, monkeypatch, measured
):
    """Powers of two are exact in float32, so differences could only come from half precision in
    cameras, colours, rasteriser or score.
    """
    ended = scaled_run(tmp_path, monkeypatch, scale, "trainer.max_steps=3")
    assert ended.code == 0, ended.err
    require_equal_ends(measured, three_steps, ended, "different from float32")


@row("A4", "GradScaler")
def test_steps_that_are_skipped_are_counted_and_reported(tmp_path, monkeypatch, measured):
    """At a loss scale of 2^127 gradients overflow until it was halved twice; the log reports the
    steps that Adam skipped.
    """
    ended = scaled_run(
        tmp_path,
        monkeypatch,
        2.0**127,
        "trainer.max_steps=5",
        "system.geometry.densify.enabled=true",
    )
    assert ended.code == 0, ended.err
    checkpoint = ended.checkpoint()
    skipped = checkpoint["global_step"] - int(checkpoint["optimizer_states"][0]["state"][0]["step"])
    assert skipped >= 2 and ended.err.count("gradients overflowed at the loss scale") == skipped
    assert all(value.isfinite().all() for value in checkpoint["state_dict"].values())
    measured(
        abs(ended.logged("train/skipped_steps")[-1] - skipped),
        "skipped steps",
        what="not counted",
        at_most=0,
    )


# ---- schedules -----------------------------------------------------------------------------------


@row("A4", "Clip schedule")
def test_the_clip_at_its_knots(measured):
    schedules = {
        (0, 1.5, 2.0, 1000): {0: 1.5, 500: 1.75, 1000: 2.0, 2000: 2.0},
        (1.5, 2.0, 1000): {0: 1.5, 500: 1.75, 1000: 2.0},
        (0, 1.0, 2.0, 10, 0.5, 20): {0: 1.0, 5: 1.5, 10: 2.0, 15: 1.25, 20: 0.5, 30: 0.5},
        (500, 0.98, 0.55, 501): {499: 0.98, 500: 0.98, 501: 0.55},
    }
    wrong = [
        abs(C(list(knots), 0, step) - value)
        for knots, values in schedules.items()
        for step, value in values.items()
    ]
    by_epoch = [
        abs(C([0, 1.5, 2.0, 10.0], epoch, 99_999) - value)
        for epoch, value in {0: 1.5, 5: 1.75, 10: 2.0}.items()
    ]
    guidance = CorruptedScore({"grad_clip": [0, 1.5, 2.0, 1000]})
    for step, value in schedules[0, 1.5, 2.0, 1000].items():
        guidance.update_step(0, step)
        wrong.append(abs(guidance.grad_clip - value))
    measured(max(wrong + by_epoch), what="error", at_most=0)


@row("A4", "Clip schedule")
@pytest.mark.parametrize(
    "knots",
    [
        [0, 1.5, 2.0, 0],
        [5, 1.5, 2.0, 5],
        [9, 1.5, 2.0, 5],
        [1.5, 2.0, 0],
        [0, 1, 2, 3, 4],
        [1],
        [],
        "1.5",
        [0, 1, math.nan, 9],
        [0, 1, 2, 10, 3, 10],
        [0, 1.0, 2.0, 10, 3.0, 20.5],
        [0, -1.0, 2.0, 9],
        -1,
        True,
        {"a": 1},
    ],
)
def test_an_invalid_clip_schedule_is_refused_when_it_is_read(knots, measured):
    with pytest.raises(UserError, match="system.guidance.grad_clip"):
        check_part("system.guidance", "stability-corrupted-guidance", {"grad_clip": knots})
    measured("bad lists refused by name")


@row("A4", "t edges")
@pytest.mark.parametrize("percents", [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.02, 0.98)])
def test_timesteps_stay_inside_the_table(percents, measured):
    drawn = torch.cat(
        [sds.timesteps(50, *sds.step_range(*percents), seed=0, step=step) for step in range(40)]
    )
    measured(((drawn < 1) | (drawn > 999)).sum(), "of 2000 outside [1, 999]", at_most=0)


@row("A4", "t edges")
def test_a_range_that_is_empty_after_annealing_is_named(measured):
    """Before any work, not at the step at which the two schedules cross."""
    crossing = {"min_step_percent": 0.6, "max_step_percent": [500, 0.98, 0.55, 501]}
    with pytest.raises(UserError, match="min_step_percent: 0.6 is above max_step_percent, 0.55"):
        check_part("system.guidance", "stability-corrupted-guidance", crossing)
    with pytest.raises(UserError, match="min_step_percent"):
        sds.step_range(0.98, 0.5)
    measured("named error")


@row("A4", "t edges")
@pytest.mark.parametrize("name", sorted(sds.WEIGHTS))
def test_the_gradient_at_the_first_and_last_timestep_is_finite(name, measured):
    """t = 0, where a/sigma is 34, is never drawn. Records which fraction of each weighting falls on
    the first tenth of the timesteps.
    """
    abar = sds.sd_alphas_cumprod()
    pull = sds.WEIGHTS[name](abar) * (abar / (1 - abar)).sqrt()
    x, noise = torch.randn(2, 3, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([1, 500, 999])
    z = sds.add_noise(x, noise, abar[t])
    assert all(
        value.isfinite().all()
        for value in (z, sds.predict_x0(z, noise, abar[t]), sds.WEIGHTS[name](abar[t]))
    )
    measured(
        100 * pull[20:100].sum() / pull[20:981].sum(),
        "%",
        what=f"{name}: weight of t < 100 among 20 to 980",
    )


# ---- resuming ------------------------------------------------------------------------------------

EVERY_STEP = ["checkpoint.every_n_train_steps=1", "trainer.max_steps=9"]


EDGE = [
    "system.guidance.max_step_percent=[5,0.98,0.55,6]",
    "system.guidance.grad_clip=[5,0.5,1.0,6]",
    "data.height=[16,24]",
    "data.width=[16,24]",
    "data.resolution_milestones=[5]",
    "system.geometry.lr_means=[5,1e-2,1e-3,6]",
    "data.train_views=0",
    "data.progressive_until=8",
    "system.loss.lambda_sds=[5,1.0,0.5,6]",
]


DENSIFYING = [
    "system.geometry.densify.enabled=true",
    "system.geometry.densify.start=1",
    "system.geometry.densify.every=2",
    "system.geometry.densify.stop=9",
    "system.geometry.densify.grad_threshold=1e-4",
    "data.train_views=0",
    "data.camera_perturb=0.1",
    "data.center_perturb=0.05",
    "data.up_perturb=0.02",
]


def resumed(folder, whole: Ended, step: int, *options) -> Ended:
    """Resume, in another folder, from the checkpoint that the uninterrupted run wrote after
    ``step``.
    """
    ended = launch(folder, *options, f"resume={whole.folder}/ckpts/epoch=0-step={step}.ckpt")
    assert ended.code == 0, ended.err
    return ended


@pytest.fixture(scope="module")
def over_the_edge(tmp_path_factory) -> Ended:
    ended = launch(tmp_path_factory.mktemp("edge"), *EDGE, *EVERY_STEP)
    assert ended.code == 0, ended.err
    assert [ended.logged("train/max_step")[step] for step in (4, 5, 6)] == [980, 980, 550]
    return ended


@row("A4", "Resume mid-schedule")
@pytest.mark.parametrize("step", [4, 5, 6])
def test_resumed_at_the_edge_of_every_schedule(step, over_the_edge, tmp_path, measured):
    """Timesteps, clip, resolution, learning rate and weight all jump from step 5 to step 6, like
    the paper's from 500 to 501.
    """
    ended = resumed(tmp_path, over_the_edge, step, *EDGE, *EVERY_STEP)
    require_equal_ends(measured, over_the_edge, ended, "different")


@pytest.fixture(scope="module")
def random_streams(tmp_path_factory) -> Ended:
    """A run that draws everything at every step: cameras, their shifts, timesteps, noise,
    backgrounds, splits.
    """
    ended = launch(tmp_path_factory.mktemp("streams"), *DENSIFYING, *EVERY_STEP)
    assert ended.code == 0, ended.err
    assert len(ended.checkpoint()["state_dict"]["geometry.means"]) > 130
    return ended


@row("A4", "RNG")
@pytest.mark.parametrize("step", [1, 4, 8])
def test_stopped_and_resumed_anywhere(step, random_streams, tmp_path, measured):
    ended = resumed(tmp_path, random_streams, step, *DENSIFYING, *EVERY_STEP)
    require_equal_ends(measured, random_streams, ended, "different")


@row("A4", "RNG")
@pytest.mark.parametrize("views, every", [(1, 3), (3, 1)])
def test_validation_changes_nothing(views, every, random_streams, tmp_path, monkeypatch, measured):
    """Neither the number of validation views nor what they draw from the process's own generators
    matters.
    """
    looked = GaussianDreamerSystem.validation_step
    seen = []

    def greedy(self, batch, batch_idx):
        seen.append((torch.rand(7), np.random.random(5), random.random()))
        return looked(self, batch, batch_idx)

    monkeypatch.setattr(GaussianDreamerSystem, "validation_step", greedy)
    validated = [
        "trainer.limit_val_batches=1.0",
        f"trainer.val_check_interval={every}",
        f"data.n_val_views={views}",
    ]
    ended = launch(tmp_path, *DENSIFYING, *EVERY_STEP, *validated, "system.guidance.eval_steps=2")
    assert ended.code == 0, ended.err
    assert len(seen) == views * (9 // every)
    require_equal_ends(measured, random_streams, ended, "different")
