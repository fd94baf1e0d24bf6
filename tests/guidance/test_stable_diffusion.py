"""Stable Diffusion's guidance: Perp-Neg's pairing, schedules, non-finite predictions, options,
pictures.
"""

import math

import pytest
import torch
from torch import nn

from tests.helpers import tiny_guidance as tiny
from tests.helpers import tiny_models
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.diffusion.sds import perp_neg, rescaled
from threestudio_gaussiandreamer.guidance.base import NonFiniteScore
from threestudio_gaussiandreamer.guidance.types import view_of_row
from threestudio_gaussiandreamer.prompts.prompts import PlainPrompt

pytest.importorskip("diffusers")


# Prompts
# --------------------------------------------------------------------------------------------------


def test_one_forward_pass_and_no_decoding_per_step(models, prompts):
    for options, perp, rows in (
        ({}, False, 8),
        ({}, True, 16),
        ({"guidance_scale": 1.0}, False, 4),
    ):
        guide = tiny.guidance(models, **options)
        guide.unet = recorder = tiny.Recorder(guide.unet)
        guide.vae.decode = lambda *args: pytest.fail("decoded in a training step")
        tiny.gradient(guide, prompts[perp], tiny.renders())
        assert [len(args[0]) for args, _ in recorder.calls] == [rows]


class HostPrompts:
    """threestudio's own pairing of rows: a loop over the views with two adjacent negative rows
    each.
    """

    use_perp_neg = True

    def __init__(self, out):
        self.out, self.get_text_embeddings = out, out.get_text_embeddings

    def get_text_embeddings_perp_neg(
        self, elevation, azimuth, camera_distances, view_dependent_prompting=True
    ):
        positive, uncond, negative, weights = [], [], [], []
        for view in zip(elevation, azimuth, camera_distances, strict=True):
            rows, weight = self.out.get_text_embeddings_perp_neg(*(value[None] for value in view))
            positive.append(rows[0])
            uncond.append(rows[1])
            negative += [rows[2], rows[3]]
            weights.append(weight[0])
        return torch.stack([*positive, *uncond, *negative]), torch.stack(weights)


@pytest.mark.parametrize("recon_std_rescale", [0.0, 0.7])
@pytest.mark.parametrize("whose", ["ours", "threestudio's"])
def test_perp_neg_of_four_views_is_that_of_each_alone(models, prompts, whose, recon_std_rescale):
    guide = tiny.guidance(models, recon_std_rescale=recon_std_rescale)
    prompt_utils = prompts[True] if whose == "ours" else HostPrompts(prompts[True])
    z = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        together = guide.predict_noise(
            z, tiny.TIMESTEPS, guide.condition(prompt_utils, **tiny.BATCH)
        )
        views = [{name: values[i : i + 1] for name, values in tiny.BATCH.items()} for i in range(4)]
        conditions = [guide.condition(prompt_utils, **view) for view in views]
        alone = [
            guide.predict_noise(z[i : i + 1], tiny.TIMESTEPS[i : i + 1], conditions[i])
            for i in range(4)
        ]
        # another batch size rounds differently, and guidance 100 magnifies that
        assert tiny.relative(together, torch.cat(alone).double()) < 1e-5
        tiled = guide.noise(
            torch.cat([z] * 4),
            torch.cat([tiny.TIMESTEPS] * 4),
            guide.condition(prompt_utils, **tiny.BATCH).embeddings,
        )
        paired = guide.noise(
            z, tiny.TIMESTEPS, guide.condition(prompt_utils, **tiny.BATCH).embeddings
        )
    torch.testing.assert_close(tiled[:8], paired[:8])
    assert tiny.relative(tiled[8:], paired[8:].double()) > 0.1, (
        "pairing by blocks would have passed too"
    )


def test_rows_are_paired_by_view():
    assert view_of_row(3, 12).tolist() == [0, 1, 2, 0, 1, 2, 0, 0, 1, 1, 2, 2]
    assert view_of_row(3, 6).tolist() == [0, 1, 2, 0, 1, 2]


def test_perp_neg_takes_away_only_what_is_perpendicular():
    draw = torch.Generator().manual_seed(0)
    cond, uncond = torch.randn(2, 1, 4, 4, 4, generator=draw).double()
    direction = cond - uncond
    along = (uncond + 3 * direction)[:, None].expand(-1, 2, -1, -1, -1)
    weights = torch.tensor([[-1.0, -2.0]]).double()
    torch.testing.assert_close(perp_neg(cond, uncond, along, weights), cond)
    negative = torch.randn(1, 2, 4, 4, 4, generator=draw).double()
    change = perp_neg(cond, uncond, negative, weights) - cond
    assert abs(float((change * direction).sum())) < 1e-12
    assert float((change * (negative - uncond[:, None]).sum(1)).sum()) < 0


def test_rescaling_restores_the_contrast_of_the_conditional_picture():
    draw = torch.Generator().manual_seed(0)
    guided, cond, z = (
        torch.randn(3, 2, 4, 8, 8, generator=draw).double()
        * torch.tensor([9.0, 1.0, 1.0])[:, None, None, None, None]
    )
    abar = torch.tensor([0.9, 0.2]).double()
    a, sigma = (root.sqrt()[:, None, None, None] for root in (abar, 1 - abar))
    x0 = lambda eps: (z - sigma * eps) / a  # noqa: E731
    torch.testing.assert_close(rescaled(guided, cond, z, abar, 0.0), guided)
    torch.testing.assert_close(
        x0(rescaled(guided, cond, z, abar, 1.0)).std(dim=(1, 2, 3)), x0(cond).std(dim=(1, 2, 3))
    )
    halfway = x0(rescaled(guided, cond, z, abar, 0.5)).std(dim=(1, 2, 3))
    torch.testing.assert_close(
        halfway, (x0(cond).std(dim=(1, 2, 3)) + x0(guided).std(dim=(1, 2, 3))) / 2
    )


def test_prompts_that_do_not_fit_are_reported(models, prompts):
    guide = tiny.guidance(models)
    for without in (PlainPrompt("a fox"), None):
        with pytest.raises(UserError, match="needs text embeddings"):
            guide(tiny.renders(), without, **tiny.BATCH)
    guide.text_width = 1024
    with pytest.raises(
        UserError, match="32 channels, .* takes 1024: .*the same pretrained_model_name_or_path"
    ):
        guide(tiny.renders(), prompts[False], **tiny.BATCH)


# Randomness and schedules
# --------------------------------------------------------------------------------------------------


def test_the_same_step_draws_the_same_and_looking_changes_nothing(models, prompts):
    guide, rgb = tiny.guidance(models), tiny.renders()
    guide.update_step(0, 7)
    before, _ = tiny.gradient(guide, prompts[False], rgb)
    tiny.gradient(guide, prompts[False], rgb, guidance_eval=True)
    guide.update_step(0, 8)
    other, _ = tiny.gradient(guide, prompts[False], rgb)
    resumed = tiny.guidance(models)
    resumed.update_step(0, 7)
    again, _ = tiny.gradient(resumed, prompts[False], rgb)
    assert torch.equal(before, again)
    assert not torch.equal(before, other)


def test_schedules_of_timesteps_and_clip(models, prompts):
    guide = tiny.guidance(
        models, max_step_percent=[500, 0.98, 0.55, 501], grad_clip=[0, 1.5, 2.0, 1000]
    )
    for step, max_step, clip in (
        (0, 980, 1.5),
        (500, 980, 1.75),
        (501, 550, 1.7505),
        (2000, 550, 2.0),
    ):
        guide.update_step(0, step)
        out = tiny.gradient(guide, prompts[False], tiny.renders())[1]
        assert (out["min_step"], out["max_step"]) == (20, max_step)
        assert guide.grad_clip == pytest.approx(clip)
        # no element of the 4 x 4 x 8 x 8 gradient is above the clip
        assert out["grad_norm"] <= clip * 32 * (1 + 1e-6)


def test_the_models_own_schedule_is_used(models, tmp_path):
    from diffusers import DDPMScheduler

    folder = tiny_models.stable_diffusion(tmp_path / "linear")
    schedule = DDPMScheduler(
        beta_schedule="linear", beta_start=0.001, beta_end=0.01, rescale_betas_zero_snr=True
    )
    schedule.save_pretrained(folder / "scheduler")
    guide = tiny.guidance({"epsilon": folder})
    assert guide.alphas_cumprod[0] > 0.99
    assert 0 < guide.alphas_cumprod[-1] < 1e-6  # zero terminal signal, without a division by zero
    guide = tiny.guidance(models)
    expected = torch.cumprod(
        1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0
    )
    torch.testing.assert_close(
        guide.alphas_cumprod, expected, rtol=1e-5, atol=0
    )  # diffusers' betas are float32


# Failures of the model
# --------------------------------------------------------------------------------------------------


class Spoiling(nn.Module):
    """A UNet with NaN in the predictions of some views."""

    def __init__(self, unet, views):
        super().__init__()
        self.unet, self.views = unet, views

    def forward(self, sample, timestep, encoder_hidden_states):
        out = self.unet(sample, timestep, encoder_hidden_states=encoder_hidden_states)
        out.sample[self.views] = math.nan
        return out


def test_a_bad_item_is_left_out_and_the_others_are_unchanged(models, prompts):
    guide, rgb = tiny.guidance(models), tiny.renders()
    clean, _ = tiny.gradient(guide, prompts[False], rgb)
    guide.unet = Spoiling(guide.unet, [1])
    corrupted, out = tiny.gradient(guide, prompts[False], rgb)
    assert out["bad_items"] == 1
    assert torch.equal(corrupted[[0, 2, 3]], clean[[0, 2, 3]])
    assert not corrupted[1].any()
    with pytest.raises(NonFiniteScore, match="10 steps in a row"):
        for _ in range(9):
            tiny.gradient(guide, prompts[False], rgb)


# Looking
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("items, shown", [(3, 3), (9, 4), (0, 4), (-1, 4)])
def test_the_number_of_shown_items(models, prompts, items, shown):
    out = tiny.guidance(models, max_items_eval=items, eval_steps=1)(
        tiny.renders(), prompts[False], **tiny.BATCH, guidance_eval=True
    )["eval"]
    assert out["bs"] == len(out["imgs_final"]) == shown


@pytest.mark.parametrize("perp", [False, True])
def test_the_pictures_of_the_evaluation(models, prompts, perp):
    guide = tiny.guidance(models, max_items_eval=3, eval_steps=2)
    out = guide(tiny.renders(), prompts[perp], **tiny.BATCH, guidance_eval=True)["eval"]
    assert out["bs"] == 3 and len(out["texts"]) == 3
    for name in ("imgs_noisy", "imgs_1step", "imgs_1orig", "imgs_final"):
        assert out[name].shape == (3, 64, 64, 3)
        assert 0 <= out[name].min() <= out[name].max() <= 1
