"""VSD with a diffusion model: the LoRA on its UNet."""

import copy

import pytest
import torch

from tests.helpers import tiny_guidance as tiny
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.guidance.variants import vsd as module
from threestudio_gaussiandreamer.guidance.variants.vsd import adapted_layers, particle_noise

pytest.importorskip("diffusers")

GOOD = torch.ones(4, dtype=torch.bool)


def cameras(count=4):
    generator = torch.Generator().manual_seed(7)
    return {"c2w": torch.randn(count, 4, 4, generator=generator)}


def vsd(models, prediction="epsilon", **variant):
    """Return a guidance and its particle model."""
    options = {"variant_type": "vsd-variant", "variant": variant, "guidance_scale": 7.5}
    guide = tiny.guidance(models, prediction, **options)
    return guide, guide.variant.particles(guide)


def inputs(guide, prompts):
    """Return latents, noisy latents and conditions of four views."""
    condition = guide.condition(prompts[False], **tiny.BATCH)
    latents = torch.randn(4, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    return latents, guide.add_noise(latents), condition


def learn(guide, latents, condition, good=GOOD):
    """Train on four views; return what is logged."""
    guide.variant.learn(guide, latents, condition, cameras(), good)
    return guide.variant.report()


def with_values(particles):
    """Fill the parts of a LoRA that start at zero."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for value in (*particles.up, particles.camera_out):
            value.copy_(0.2 * torch.randn(value.shape, generator=generator))


def merged(guide, particles):
    """Return a copy of the UNet with the products of the LoRA added to its weights."""
    unet = copy.deepcopy(guide.unet)
    with torch.no_grad():
        for layer, down, up in zip(adapted_layers(unet), particles.down, particles.up, strict=True):
            layer.weight += up @ down
    return unet


def test_the_lora_is_in_every_attention_starts_as_the_unet_and_is_restored(models, prompts):
    guide, particles = vsd(models)
    attentions = [m for m in guide.unet.modules() if type(m).__name__ == "Attention"]
    layers = {id(x) for m in attentions for x in (m.to_q, m.to_k, m.to_v, m.to_out[0])}
    assert {id(layer) for layer in adapted_layers(guide.unet)} == layers
    latents, noised, condition = inputs(guide, prompts)
    with torch.no_grad():
        own = particles.predict(guide, noised, condition, cameras())
        assert torch.equal(own, guide.conditional(noised.z, noised.t, condition))
    guide, particles = vsd(models, lr=1e-3)
    latents, _, condition = inputs(guide, prompts)
    learn(guide, latents, condition)
    saved = {name: value.clone() for name, value in guide.variant.state().items()}
    other, restored = vsd(models, lr=1e-3)
    other.variant.restore(other, saved)
    for guidance in (guide, other):
        guidance.update_step(0, 1)
        learn(guidance, latents, condition)
    ours, theirs = particles.state(), restored.state()
    assert ours.keys() == theirs.keys() == saved.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert any(not torch.equal(ours[name], saved[name]) for name in ours)
    smaller, _ = vsd(models, rank=2)
    refused("had learnt .* resume with the configuration", smaller.variant.restore, smaller, saved)


@pytest.mark.parametrize("prediction", tiny.PREDICTIONS)
def test_the_error_is_the_guided_noise_minus_that_of_the_merged_lora(models, prompts, prediction):
    """The camera in the class embedding; tests/host/test_real_variants.py runs threestudio's."""
    guide, particles = vsd(models, prediction)
    with_values(particles)
    latents, noised, condition = inputs(guide, prompts)
    views, lora, unet = cameras(), particles, merged(guide, particles)
    embedding = torch.nn.functional.silu(views["c2w"].flatten(1) @ lora.camera_in.T)
    unet.class_embedding = lambda labels: embedding @ lora.camera_out.T

    def noise(network, text, **options):
        output = network(noised.z, noised.t, encoder_hidden_states=text, **options).sample
        squares = (noised.abar, 1 - noised.abar)
        a, sigma = (x.sqrt().float().reshape(-1, 1, 1, 1) for x in squares)
        return a * output + sigma * noised.z if prediction == "v_prediction" else output

    cond, uncond = condition.embeddings.chunk(2)
    with torch.no_grad():
        error, _ = guide.variant.residual(guide, latents, condition, views)
        own = noise(unet, cond, class_labels=torch.zeros(4))
        plain, negative = noise(guide.unet, cond), noise(guide.unet, uncond)
    expected = negative + 7.5 * (plain - negative) - own
    assert (own - plain).abs().max() > 0.1
    torch.testing.assert_close(error, expected, rtol=0, atol=1e-5)


def test_the_lora_follows_the_gradient_of_the_mean_squared_error(models, prompts, monkeypatch):
    """Adam's gradient, without the camera, against autograd through the merged weights."""
    monkeypatch.setattr(module, "CAMERA_DROPOUT", 1.0)
    guide, particles = vsd(models)
    with_values(particles)
    latents, _, condition = inputs(guide, prompts)
    particles.optimizer.step = lambda: None
    numbers = learn(guide, latents, condition)
    unet = merged(guide, particles).requires_grad_(True)
    noised, text = particle_noise(guide, latents), condition.embeddings[:4]
    predicted = unet(noised.z, noised.t, encoder_hidden_states=text).sample
    loss = torch.nn.functional.mse_loss(predicted, noised.noise)
    loss.backward()
    assert numbers["lora_error"] == pytest.approx(loss.item(), rel=1e-5)
    for layer, down, up in zip(adapted_layers(unet), particles.down, particles.up, strict=True):
        whole = layer.weight.grad
        torch.testing.assert_close(up.grad, whole @ down.T, rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(down.grad, up.T @ whole, rtol=1e-3, atol=1e-6)


def test_the_lora_alone_learns_and_not_in_evaluations_or_from_bad_items(models, prompts):
    guide, particles = vsd(models, lr=1e-2)
    before = {name: value.clone() for name, value in guide.unet.state_dict().items()}
    latents, noised, condition = inputs(guide, prompts)

    def error():
        predicted = particles.predict(guide, noised, condition, cameras())
        return float((predicted - noised.noise).square().mean())

    start = error()
    for at in range(12):
        guide.update_step(0, at)
        learn(guide, latents, condition)
    assert error() < 0.97 * start
    after = guide.unet.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert not any(layer._forward_hooks for layer in guide.unet.modules())
    guide, particles = vsd(models)
    before = {name: value.clone() for name, value in particles.state().items()}
    rgb, views = tiny.renders(2), tiny.first(2) | cameras(2)
    guide(rgb, prompts[False], guidance_eval=True, **views)
    assert all(torch.equal(particles.state()[name], value) for name, value in before.items())
    guide(rgb, prompts[False], **views)
    assert any(not torch.equal(particles.state()[name], value) for name, value in before.items())
    latents, _, condition = inputs(guide, prompts)
    latents[2] = torch.nan
    good = torch.tensor([True, True, False, True])
    assert learn(guide, latents, condition, good)["lora_error"] > 0
    assert all(value.isfinite().all() for value in particles.state().values())
    assert learn(guide, latents, condition, ~GOOD) == {}
