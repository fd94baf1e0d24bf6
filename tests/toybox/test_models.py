"""The toybox's networks at their full sizes: small enough, and initialised to learn quickly."""

import pytest
import torch

from threestudio_gaussiandreamer.priors.point_e import BaseModel
from threestudio_gaussiandreamer.toybox import models, words
from threestudio_gaussiandreamer.toybox.tokens import open_tokenizer

LARGEST = 20e6
"""Bytes of all shipped models together."""
BYTES = 2
"""Of a weight in float16."""


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return models.clip_model(len(open_tokenizer(tmp_path_factory.mktemp("clip"))))


def size(network) -> int:
    return BYTES * sum(value.numel() for value in network.parameters())


def test_all_models_together_are_small_enough(clip):
    sizes = (models.POINTS_WIDTH, models.POINTS_LAYERS, models.FEATURES)
    others = (models.autoencoder(), models.unet(), BaseModel(*sizes), models.Judge())
    twice = clip.text_model  # it lies in the Stable Diffusion folder too
    assert size(clip) + size(twice) + sum(map(size, others)) < 0.99 * LARGEST


def test_the_vocabulary_fits_the_text_encoder(clip):
    assert clip.config.text_config.vocab_size > len(words.vocabulary())


def test_the_unet_starts_at_zero():
    z, tokens = torch.randn(2, 4, 16, 16), torch.randn(2, 32, models.TEXT_WIDTH)
    output = models.unet()(z, torch.tensor([10, 900]), encoder_hidden_states=tokens).sample
    assert output.abs().max() == 0


def test_residual_blocks_and_attention_start_as_identity():
    unet, x = models.unet(), torch.randn(1, models.UNET_CHANNELS[1], 8, 8)
    block = unet.down_blocks[1]
    assert torch.equal(block.attentions[0](x, torch.randn(1, 32, models.TEXT_WIDTH)).sample, x)
    vae = models.autoencoder()
    channels = models.VAE_CHANNELS[0]
    x = torch.randn(1, channels, 16, 16)
    assert torch.equal(vae.encoder.down_blocks[0].resnets[0](x, None), x)


def test_resampling_starts_as_an_average():
    down = models.autoencoder().encoder.down_blocks[0].downsamplers[0]
    x = torch.ones(1, models.VAE_CHANNELS[0], 8, 8) * 3
    with torch.no_grad():
        y = down(x)
    assert y.shape[-1] == 4
    # small random weights are left, so that gradients differ between channels
    assert y[..., :-1, :-1].mean() == pytest.approx(3, abs=0.5)


def test_the_posterior_starts_with_little_noise():
    vae = models.autoencoder()
    with torch.no_grad():
        std = vae.encode(torch.rand(1, 3, 128, 128) * 2 - 1).latent_dist.std
    assert std.max() < 0.2
