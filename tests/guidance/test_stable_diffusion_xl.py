"""Stable Diffusion XL's guidance: two text encoders, pooled embedding and sizes; its gradient
against float64 and in closed form.
"""

import json

import pytest
import torch

from tests.helpers import tiny_large_guidance as tiny
from tests.helpers import tiny_large_models, tiny_models
from tests.helpers.tiny_guidance import Recorder, relative, renders
from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import text_to_image
from threestudio_gaussiandreamer.models.text_encoders import unpack

pytest.importorskip("diffusers")
KIND = "stable-diffusion-xl"
POOLED = tiny_large_models.POOLED


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return tiny_large_models.stable_diffusion_xl(tmp_path_factory.mktemp("models") / "xl")


@pytest.fixture(scope="module")
def prompts(model):
    return tiny.prompts(KIND, model)


def reference_gradient(model, prompt_utils, rgb, *, scale):
    """Compute the SDS gradient in float64, item by item, one forward pass per prompt."""
    from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel

    unet = UNet2DConditionModel.from_pretrained(model, subfolder="unet").double().eval()
    vae = AutoencoderKL.from_pretrained(model, subfolder="vae").double().eval()
    betas = DDPMScheduler.from_pretrained(model, subfolder="scheduler").betas.double()
    alphas = torch.cumprod(1 - betas, 0)
    batch = tiny.views()
    del batch["c2w"]
    tokens, pooled = unpack(prompt_utils.get_text_embeddings(**batch).double(), POOLED)
    sizes = torch.tensor([[64, 64, 0, 0, 64, 64]]).double()
    total = torch.zeros_like(rgb, dtype=torch.float64)
    for i, image in enumerate(rgb.detach().double()):
        draw = lambda stream, i=i: streams.generator(0, stream, 0, i)  # noqa: E731
        t = int(torch.randint(20, 981, (), generator=draw("timestep")))
        image = image.permute(2, 0, 1)[None].requires_grad_()
        posterior = vae.encode(image * 2 - 1).latent_dist
        x = 0.13025 * (
            posterior.mean + posterior.std * torch.randn(4, 8, 8, generator=draw("vae")).double()
        )
        eps = torch.randn(4, 8, 8, generator=draw("noise")).double()
        z = alphas[t].sqrt() * x + (1 - alphas[t]).sqrt() * eps
        with torch.no_grad():
            cond, uncond = (
                unet(
                    z,
                    t,
                    encoder_hidden_states=tokens[row : row + 1],
                    added_cond_kwargs={"text_embeds": pooled[row : row + 1], "time_ids": sizes},
                ).sample
                for row in (i, i + len(rgb))
            )
        grad = (1 - alphas[t]) * (uncond + scale * (cond - uncond) - eps)
        (back,) = torch.autograd.grad(x, image, grad / len(rgb))
        total[i] = back[0].permute(1, 2, 0)
    return total


def test_the_gradient_is_that_of_a_float64_reference(model, prompts):
    rgb = renders()
    mine, _ = tiny.gradient(tiny.guidance(KIND, model), prompts, rgb)
    # guidance 100 magnifies the rounding of float32 a hundredfold
    assert relative(mine, reference_gradient(model, prompts, rgb, scale=100.0)) < 1e-5


def test_the_gradient_towards_one_known_latent_is_the_closed_form(model, prompts):
    """With one mode of zero width the noise cancels: grad = w(t) a / sigma (x - x1)."""
    target = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    guide = tiny.guidance(KIND, model, guidance_scale=1.0, min_step_percent=0.2)

    def exact(z, t, **conditions):
        abar = guide.alphas_cumprod[t][:, None, None, None]
        return ((z - abar.sqrt() * target) / (1 - abar).sqrt()).float()

    guide.unet = tiny.StandIn(guide.unet, exact)
    latents = torch.randn(4, 8, 8, 4, generator=torch.Generator().manual_seed(2)).requires_grad_()
    mine, _ = tiny.gradient(guide, prompts, latents, rgb_as_latents=True)
    abar = guide.alphas_cumprod[guide.draw_timesteps(latents)[0]][:, None, None, None]
    difference = latents.detach().double() - target.movedim(1, -1)
    expected = (1 - abar) * (abar / (1 - abar)).sqrt() * difference / 4
    assert relative(mine, expected) < 1e-5


def test_the_unet_gets_the_pooled_embedding_and_the_sizes(model, prompts):
    guide = tiny.guidance(KIND, model, image_size=128)
    guide.unet = recorder = Recorder(guide.unet)
    tiny.gradient(guide, prompts, renders())
    ((_, options),) = recorder.calls
    assert options["encoder_hidden_states"].shape == (8, 77, 64)
    added = options["added_cond_kwargs"]
    assert added["time_ids"].tolist() == [[128, 128, 0, 0, 128, 128]] * 8
    assert torch.equal(added["text_embeds"][4:], prompts.uncond_text_embeddings_vd[:4, -1, :POOLED])


@pytest.mark.parametrize("half_type", ["float16", "bfloat16"])
@pytest.mark.parametrize("force_upcast", [True, False])
def test_half_precision_and_a_vae_that_overflows(
    prompts, model, tmp_path, monkeypatch, half_type, force_upcast
):
    folder = tiny_large_models.stable_diffusion_xl(tmp_path / "xl", force_upcast=force_upcast)
    dtype = getattr(torch, half_type)
    monkeypatch.setattr(text_to_image, "weights_type", lambda *options: dtype)
    guide, rgb = tiny.guidance(KIND, folder, half_precision_type=half_type), renders()
    assert guide.unet.dtype == dtype
    stays = force_upcast and dtype == torch.float16
    assert guide.vae.dtype == (torch.float32 if stays else dtype)
    mine, out = tiny.gradient(guide, prompts, rgb)
    assert (
        mine.dtype
        == out["loss_sds"].dtype
        == guide.decode(guide.encode(rgb.movedim(-1, 1))).dtype
        == torch.float32
    )
    # bfloat16 rounds to 4e-3, which guidance 100 magnifies
    assert relative(mine, reference_gradient(folder, prompts, rgb, scale=100.0)) < 0.5


def test_perp_neg_and_the_pictures_of_the_evaluation(model):
    prompt_utils = tiny.prompts(KIND, model, use_perp_neg=True)
    guide = tiny.guidance(KIND, model, eval_steps=1)
    out = guide(renders(), prompt_utils, **tiny.views(), guidance_eval=True)["eval"]
    assert out["imgs_final"].shape == (4, 64, 64, 3) and out["imgs_final"].isfinite().all()


def test_other_models_are_refused_by_name(model, tmp_path):
    other = tiny_models.stable_diffusion(tmp_path / "sd")
    said = "isn't Stable Diffusion XL, but Stable Diffusion 1.x.*--config gaussiandreamer.yaml"
    for build in (tiny.guidance, tiny.prompts):
        with pytest.raises(UserError, match=said):
            build(KIND, other)
    with pytest.raises(UserError, match="isn't Stable Diffusion 1.x.*gaussiandreamer-sdxl.yaml"):
        tiny.guidance("stable-diffusion", model)
    with pytest.raises(UserError, match="64 channels.*takes 32"):
        guide = tiny.guidance("stable-diffusion", other)
        tiny.gradient(guide, tiny.prompts(KIND, model), renders())


def test_the_refiner_is_refused(tmp_path):
    folder = tiny_large_models.stable_diffusion_xl(tmp_path / "refiner")
    index = folder / "model_index.json"
    settings = json.loads(index.read_text()) | {"requires_aesthetics_score": True}
    index.write_text(json.dumps(settings))
    with pytest.raises(UserError, match="refiner.*use the base model"):
        tiny.guidance(KIND, folder)
