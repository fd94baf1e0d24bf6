"""The toybox's networks at their full sizes: small enough, and initialised to learn quickly."""

import torch

from threestudio_gaussiandreamer.priors.point_e import BaseModel
from threestudio_gaussiandreamer.toybox import models, words
from threestudio_gaussiandreamer.toybox.tokens import open_tokenizer

LARGEST = 20e6
"""Bytes of all shipped models together, with two of a weight."""


def size(network) -> int:
    return 2 * sum(value.numel() for value in network.parameters())


def test_all_models_together_are_small_enough(tmp_path):
    clip = models.clip_model(len(open_tokenizer(tmp_path)))
    assert clip.config.text_config.vocab_size > len(words.vocabulary())
    sizes = (models.POINTS_WIDTH, models.POINTS_LAYERS, models.FEATURES)
    others = (models.autoencoder(), models.unet(), BaseModel(*sizes), models.Judge())
    twice = clip.text_model  # it lies in the Stable Diffusion folder too
    assert size(clip) + size(twice) + sum(map(size, others)) < 0.99 * LARGEST


@torch.no_grad()
def test_networks_start_as_identity_with_little_noise():
    unet, vae = models.unet(), models.autoencoder()
    tokens = torch.randn(2, 32, models.TEXT_WIDTH)
    z, t = torch.randn(2, 4, 16, 16), torch.tensor([10, 900])
    assert unet(z, t, encoder_hidden_states=tokens).sample.abs().max() == 0
    x = torch.randn(1, models.UNET_CHANNELS[1], 8, 8)
    assert torch.equal(unet.down_blocks[1].attentions[0](x, tokens[:1]).sample, x)
    block, x = vae.encoder.down_blocks[0], torch.randn(1, models.VAE_CHANNELS[0], 16, 16)
    assert torch.equal(block.resnets[0](x, None), x)
    y = block.downsamplers[0](torch.full_like(x, 3.0))  # an average
    # small random weights are left, so that gradients differ between channels
    assert y.shape[-1] == 8 and abs(y[..., :-1, :-1].mean() - 3) < 0.5
    posterior = vae.encode(torch.rand(1, 3, 128, 128) * 2 - 1).latent_dist
    assert posterior.std.max() < 0.2
