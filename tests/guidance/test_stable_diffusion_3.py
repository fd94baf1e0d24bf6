"""Stable Diffusion 3's guidance: a rectified flow; its gradient against float64 and in closed
form.
"""

import json

import pytest
import torch

from tests.helpers import tiny_large_guidance as tiny
from tests.helpers import tiny_large_models
from tests.helpers.tiny_guidance import Recorder, in_double, posterior_sample, relative, renders
from tests.helpers.tiny_guidance import reference_gradient as in_float64
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.models.text_encoders import unpack

pytest.importorskip("diffusers")
KIND = "stable-diffusion-3"
POOLED = 2 * tiny_large_models.POOLED


@pytest.fixture
def prompts(large):
    return large(KIND)[1]


def sigma_of(t, shift=3.0):
    u = t / 1000
    return shift * u / (1 + (shift - 1) * u)


def reference_gradient(model, prompt_utils, rgb, *, scale):
    """Compute the RFDS gradient v_hat - (eps - x) in the flow's own variables."""
    from diffusers import AutoencoderKL, SD3Transformer2DModel

    transformer = in_double(SD3Transformer2DModel, model, "transformer")
    vae = in_double(AutoencoderKL, model, "vae")
    batch = {name: value for name, value in tiny.views().items() if name != "c2w"}
    tokens, pooled = unpack(prompt_utils.get_text_embeddings(**batch).double(), POOLED)

    def network(z, t, row):
        time = torch.tensor([1000 * sigma_of(t)]).double()
        return transformer(z, tokens[row], pooled[row], time).sample

    def encode(image, generator):
        return 1.5305 * (posterior_sample(vae, image, generator) - 0.0609)

    def path(t):
        return 1 - sigma_of(t), sigma_of(t)

    return in_float64(rgb, network, encode, path, scale=scale, last=700, velocity=True)


def test_the_gradient_is_that_of_rfds_in_float64(model, prompts):
    rgb = renders()
    mine, _ = tiny.gradient(tiny.guidance(KIND, model, max_step_percent=0.7), prompts, rgb)
    # guidance 100 magnifies the rounding of float32 a hundredfold
    assert relative(mine, reference_gradient(model, prompts, rgb, scale=100.0)) < 1e-5


@pytest.mark.parametrize("shift", [None, 1.0])
def test_the_gradient_towards_one_known_latent_is_the_closed_form(model, prompts, shift):
    """With one mode of zero width the noise cancels: v_hat - v = (x - x1) / sigma."""
    target = torch.randn(1, 16, 8, 8, generator=torch.Generator().manual_seed(1))
    guide = tiny.guidance(KIND, model, guidance_scale=1.0, flow_shift=shift, min_step_percent=0.1)

    def exact(hidden_states, timestep, **conditions):
        return (hidden_states - target) / (timestep / 1000)[:, None, None, None]

    guide.transformer = tiny.StandIn(guide.transformer, exact)
    latents = torch.randn(4, 8, 8, 16, generator=torch.Generator().manual_seed(2)).requires_grad_()
    mine, _ = tiny.gradient(guide, prompts, latents, rgb_as_latents=True)
    sigma = sigma_of(guide.draw_timesteps(latents)[0].double(), shift or 3.0)
    expected = (latents.detach().double() - target.movedim(1, -1)) / sigma[:, None, None, None] / 4
    assert relative(mine, expected) < 1e-5


def test_the_transformer_gets_its_own_timesteps_and_path(model, prompts):
    guide = tiny.guidance(KIND, model)
    guide.transformer = recorder = Recorder(guide.transformer)
    recorder.config = recorder.network.config
    tiny.gradient(guide, prompts, renders())
    ((_, options),) = recorder.calls
    t = guide.draw_timesteps(torch.zeros(4, 1))[0].double()
    expected = 1000 * sigma_of(t.repeat(2))
    torch.testing.assert_close(options["timestep"].double(), expected, rtol=1e-5, atol=0)
    assert options["encoder_hidden_states"].shape == (8, 77 + 256, tiny_large_models.T5_WIDTH)
    assert options["pooled_projections"].shape == (8, POOLED)


def test_the_size_is_the_models_unless_given(model, prompts):
    assert tiny.guidance(KIND, model).image_size == 64
    assert tiny.guidance(KIND, model, image_size=96).image_size == 96
    tiny.gradient(tiny.guidance(KIND, model, image_size=192), prompts, renders())
    with pytest.raises(UserError, match="image_size: expected a multiple of 16"):
        tiny.guidance(KIND, model, image_size=72)
    with pytest.raises(UserError, match="image_size: .* positions up to 192 pixels, got 208"):
        tiny.guidance(KIND, model, image_size=208)


def test_a_shift_that_depends_on_the_picture_is_asked_for(tmp_path):
    folder = tiny_large_models.stable_diffusion_3(tmp_path / "dynamic")
    file = folder / "scheduler" / "scheduler_config.json"
    settings = json.loads(file.read_text()) | {"use_dynamic_shifting": True}
    file.write_text(json.dumps(settings))
    with pytest.raises(UserError, match="set system.guidance.flow_shift"):
        tiny.guidance(KIND, folder)
    assert tiny.guidance(KIND, folder, flow_shift=3.0).image_size == 64
