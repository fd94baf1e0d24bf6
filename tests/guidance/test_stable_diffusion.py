"""Stable Diffusion's guidance: Perp-Neg's pairing, schedules, options, pictures."""

import json

import pytest
import torch
import torch.nn.functional as F

from tests.helpers import tiny_guidance as tiny
from tests.helpers import tiny_models
from tests.helpers.refusals import refused
from tests.helpers.tiny_guidance import Recorder, gradient, guidance, relative, renders
from threestudio_gaussiandreamer.diffusion.sds import perp_neg
from threestudio_gaussiandreamer.guidance import mvdream, text_to_image, types

pytest.importorskip("diffusers")


def test_one_forward_pass_per_step_which_draws_the_same_again(models, prompts):
    for options, perp, rows in (({}, False, 8), ({}, True, 16), ({"guidance_scale": 1}, False, 4)):
        guide = tiny.guidance(models, **options)
        guide.unet = recorder = tiny.Recorder(guide.unet)
        guide.vae.decode = lambda *args: pytest.fail("decoded in a training step")
        tiny.gradient(guide, prompts[perp], tiny.renders())
        assert [len(args[0]) for args, _ in recorder.calls] == [rows]
    guide, rgb = tiny.guidance(models), tiny.renders()
    guide.update_step(0, 7)
    before, _ = tiny.gradient(guide, prompts[False], rgb)
    _, out = tiny.gradient(guide, prompts[True], rgb, guidance_eval=True)
    picture = out["eval"]["imgs_final"]
    assert picture.shape == (4, 64, 64, 3) and 0 <= picture.min() <= picture.max() <= 1
    guide.update_step(0, 8)
    other, _ = tiny.gradient(guide, prompts[False], rgb)
    resumed = tiny.guidance(models)
    resumed.update_step(0, 7)
    again, _ = tiny.gradient(resumed, prompts[False], rgb)
    assert torch.equal(before, again)
    assert not torch.equal(before, other)


def test_perp_neg_is_that_of_each_view_and_takes_away_what_is_perpendicular(models, prompts):
    guide = tiny.guidance(models, recon_std_rescale=0.7)
    z, t = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0)), tiny.TIMESTEPS
    together = guide.predict_noise(z, t, guide.condition(prompts[True], **tiny.BATCH))
    for i in range(4):
        view = {name: values[i : i + 1] for name, values in tiny.BATCH.items()}
        condition = guide.condition(prompts[True], **view)
        alone = guide.predict_noise(z[i : i + 1], t[i : i + 1], condition)
        # another batch size rounds differently, and guidance 100 magnifies that
        assert tiny.relative(together[i : i + 1], alone.double()) < 1e-5
    assert types.view_of_row(3, 12).tolist() == [0, 1, 2, 0, 1, 2, 0, 0, 1, 1, 2, 2]
    assert types.view_of_row(3, 6).tolist() == [0, 1, 2, 0, 1, 2]
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


def test_the_models_own_schedule_is_used_and_other_models_are_refused(models, tmp_path):
    from diffusers import DDPMScheduler

    folder = tiny_models.stable_diffusion(tmp_path / "linear")
    betas = {"beta_schedule": "linear", "beta_start": 0.001, "beta_end": 0.01}
    schedule = DDPMScheduler(**betas, rescale_betas_zero_snr=True)
    schedule.save_pretrained(folder / "scheduler")
    found = tiny.guidance({"epsilon": folder}).alphas_cumprod
    # zero terminal signal, without a division by zero
    assert found[0] > 0.99 and 0 < found[-1] < 1e-6
    roots = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64)
    expected, found = torch.cumprod(1 - roots**2, 0), tiny.guidance(models).alphas_cumprod
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)  # diffusers' are float32
    from diffusers import FlowMatchEulerDiscreteScheduler, UNet2DConditionModel

    folder = tiny_models.stable_diffusion(tmp_path / "other", prediction="flow_prediction")
    refused("prediction_type.*did you mean 'v_prediction'", guidance, {"epsilon": folder})
    FlowMatchEulerDiscreteScheduler().save_pretrained(folder / "scheduler")
    refused("no beta_schedule", guidance, {"epsilon": folder})
    folder = tiny_models.stable_diffusion(tmp_path / "model")
    config = UNet2DConditionModel.load_config(folder / "unet")
    for trained in (None, [8, 8]):
        text = json.dumps(dict(config) | {"sample_size": trained})
        (folder / "unet" / "config.json").write_text(text)
        refused("set system.guidance.image_size", guidance, {"epsilon": folder})
    assert guidance({"epsilon": folder}, image_size=64).image_size == 64
    for other in ({"in_channels": 9}, {"class_embed_type": "timestep"}):
        UNet2DConditionModel.from_config(config | other).save_pretrained(folder / "unet")
        said = "needs other inputs than text .*" + " ".join(map(str, *other.items()))
        refused(said, guidance, {"epsilon": folder})


@pytest.mark.parametrize(
    "saver", ["vae_slicing", "channels_last_format", "attention_slicing", "sequential_cpu_offload"]
)
def test_memory_savers_change_nothing_but_memory(models, prompts, saver):
    if saver == "sequential_cpu_offload":
        pytest.importorskip("accelerate")
    rgb = renders()
    plain, _ = gradient(guidance(models), prompts[False], rgb)
    saving, _ = gradient(guidance(models, **{f"enable_{saver}": True}), prompts[False], rgb)
    # sums in another order, magnified by guidance 100
    assert relative(saving, plain.double()) < 1e-5


def test_slicing_keeps_the_activations_of_one_image(models):
    kept, sizes = [], {}
    for slicing, passes in ((False, [4]), (True, [1] * 4)):
        kept.clear()
        guide = guidance(models, enable_vae_slicing=slicing)
        guide.vae.encoder = recorder = Recorder(guide.vae.encoder)
        hooks = (lambda tensor: kept.append(tensor.numel()) or tensor), (lambda tensor: tensor)
        with torch.autograd.graph.saved_tensors_hooks(*hooks):
            guide.encode(renders().movedim(-1, 1))
        assert [len(args[0]) for args, _ in recorder.calls] == passes
        sizes[slicing] = sum(kept)
    assert sizes[True] < sizes[False] / 20


def test_an_unusual_scale_is_told_and_compiling_asked_for_once(models, caplog, monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda network: asked.append(network) or network)
    for scale, warned in ((-5, True), (101, False), (1e6, True)):
        caplog.clear()
        guide = guidance(models, guidance_scale=scale, enable_torch_compile=scale == -5)
        assert ("guidance_scale" in caplog.text) == warned
        if scale == -5:
            assert asked == [guide.unet]


def test_halving_is_the_mean_of_four_pixels_and_more_loses_none():
    images = torch.rand(2, 3, 128, 128)
    torch.testing.assert_close(text_to_image.resized(images, 64), F.avg_pool2d(images, 2))
    images = torch.rand(1, 3, 256, 256, requires_grad=True)
    (grad,) = torch.autograd.grad(text_to_image.resized(images, 16).sum(), images)
    assert (grad > 0).all()


CONTRAST = 0.75
BATCH = tiny.BATCH | {"elevation": torch.tensor([0.0, 10.0, 20.0, -5.0])}
"""Front, left, back and right."""
TURNED = BATCH | {"azimuth": BATCH["azimuth"] + 180}


def test_the_conditional_prediction_moves_away_from_the_opposite_views(models):
    """Of timesteps 40, 400, 700 and 950 of 1000 at those from 400 on."""
    views = tiny.left_and_right(models)
    z = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(0))

    def predictions(batch, contrast):
        guide = tiny.guidance(models, guidance_scale=4.0, view_contrast=contrast)
        guide.evaluations = 0
        return guide, *guide.predict(z, tiny.TIMESTEPS, guide.condition(views, **batch))

    _, plain, uncond = predictions(BATCH, 0.0)
    _, other, _ = predictions(TURNED, 0.0)
    guide, cond, same = predictions(BATCH, CONTRAST)
    torch.testing.assert_close(cond[1:], (plain + CONTRAST * (plain - other))[1:])
    torch.testing.assert_close(cond[0], plain[0])
    torch.testing.assert_close(same, uncond)
    assert guide.evaluations == 8 + 3
    assert all(tiny.relative(*pair) > 1e-3 for pair in zip(cond[1:], plain[1:], strict=True))
    options = {"guidance_scale": 4.0, "view_contrast": CONTRAST}
    guide = tiny.guidance(models, **options, guidance_interval=(0.5, 1.0))
    condition = guide.condition(views, **BATCH)
    got = guide.predict_noise(z, tiny.TIMESTEPS, condition)
    expected = tiny.guidance(models, **options).predict_noise(z, tiny.TIMESTEPS, condition)
    torch.testing.assert_close(got[2:], expected[2:])
    plain = guide.conditional(z, tiny.TIMESTEPS, condition)
    torch.testing.assert_close(got[:2], plain[:2])


def test_what_has_one_prompt_for_all_views_refuses_it(models):
    refused("one prompt for all views", mvdream.MVDreamGuidance, {"view_contrast": 1.0})
    contrast = {"view_contrast": 1.0, "view_dependent_prompting": False}
    refused("view_dependent_prompting=true", tiny.guidance, models, **contrast)
