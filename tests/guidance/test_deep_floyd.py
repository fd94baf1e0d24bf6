"""DeepFloyd IF's guidance: pixels, six output channels, T5 embeddings; its gradient against
float64.
"""

import pytest
import torch

from tests.helpers import tiny_models

pytest.importorskip("diffusers")

from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import deep_floyd
from threestudio_gaussiandreamer.host import NAME, find

BATCH = {
    "elevation": torch.tensor([0.0, 10.0, 70.0, -5.0]),
    "azimuth": torch.tensor([10.0, 60.0, 170.0, -120.0]),
    "camera_distances": torch.tensor([2.0, 3.0, 1.5, 4.0]),
}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return tiny_models.deep_floyd(tmp_path_factory.mktemp("models") / "if")


@pytest.fixture(scope="module")
def prompts(model):
    options = {
        "pretrained_model_name_or_path": str(model),
        "prompt": "a fox",
        "negative_prompt": "ugly",
        "use_cache": False,
    }
    processor = find("gaussiandreamer-deep-floyd-prompt-processor")
    return {perp: processor({**options, "use_perp_neg": perp})() for perp in (False, True)}


def guidance(model, **options):
    return find("gaussiandreamer-deep-floyd-guidance")(
        {"pretrained_model_name_or_path": str(model), **options}
    )


def renders(size=16):
    return torch.rand(4, size, size, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()


def gradient(guide, prompt_utils, rgb, **options):
    out = guide(rgb, prompt_utils, **BATCH, **options)
    return torch.autograd.grad(out["loss_sds"], rgb)[0], out


def reference_gradient(model, prompt_utils, rgb, *, scale):
    """Compute the SDS gradient in float64, item by item, one forward pass per prompt."""
    from diffusers import DDPMScheduler, UNet2DConditionModel

    unet = UNet2DConditionModel.from_pretrained(model, subfolder="unet").double().eval()
    alphas = torch.cumprod(
        1 - DDPMScheduler.from_pretrained(model, subfolder="scheduler").betas.double(), 0
    )
    cond, uncond = prompt_utils.get_text_embeddings(**BATCH).double().chunk(2)
    total = torch.zeros_like(rgb, dtype=torch.float64)
    for i, image in enumerate(rgb.detach().double()):
        t = int(torch.randint(20, 981, (), generator=streams.generator(0, "timestep", 0, i)))
        eps = torch.randn(3, 16, 16, generator=streams.generator(0, "noise", 0, i)).double()
        x = image.permute(2, 0, 1)[None] * 2 - 1
        z = alphas[t].sqrt() * x + (1 - alphas[t]).sqrt() * eps
        with torch.no_grad():
            c, u = (
                unet(z, t, encoder_hidden_states=text[i : i + 1]).sample[:, :3]
                for text in (cond, uncond)
            )
        grad = (1 - alphas[t]) * (u + scale * (c - u) - eps)
        total[i] = 2 * grad[0].permute(1, 2, 0) / len(rgb)
    return total


def test_the_gradient_is_that_of_a_float64_reference(model, prompts):
    rgb = renders()
    mine, _ = gradient(guidance(model), prompts[False], rgb)
    expected = reference_gradient(model, prompts[False], rgb, scale=20.0)
    # float32, magnified twentyfold by the guidance
    assert (mine - expected).norm() / expected.norm() < 1e-5


@pytest.mark.parametrize("perp", [False, True])
def test_the_variance_that_the_unet_also_predicts_is_left_out(model, prompts, perp):
    guide, rgb = guidance(model), renders()
    before, _ = gradient(guide, prompts[perp], rgb)
    with torch.no_grad():
        guide.unet.conv_out.weight[3:] += 1.0
    after, _ = gradient(guide, prompts[perp], rgb)
    assert torch.equal(before, after)


def test_perp_neg_of_four_views_is_that_of_each_alone(model, prompts):
    guide = guidance(model)
    z = torch.randn(4, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([40, 400, 700, 950])
    with torch.no_grad():
        together = guide.predict_noise(z, t, guide.condition(prompts[True], **BATCH))
        for i in range(4):
            alone = guide.condition(
                prompts[True], **{name: values[i : i + 1] for name, values in BATCH.items()}
            )
            error = guide.predict_noise(z[i : i + 1], t[i : i + 1], alone) - together[i : i + 1]
            # another batch size rounds differently
            assert error.norm() / together[i].norm() < 1e-5


def test_the_render_is_seen_at_the_models_size(model, prompts):
    guide = guidance(model)
    rgb = renders(size=128)
    mine, out = gradient(guide, prompts[False], rgb)
    assert guide.encode(rgb.movedim(-1, 1)).shape == (4, 3, 16, 16)
    assert (mine != 0).all(), "a pixel that the model doesn't see is never trained"
    assert torch.isfinite(out["loss_sds"])
    assert guidance(model, image_size=32).encode(rgb.movedim(-1, 1)).shape == (4, 3, 32, 32)


def test_encode_and_decode_are_inverse(model):
    guide = guidance(model)
    images = renders().detach().movedim(-1, 1)
    torch.testing.assert_close(guide.decode(guide.encode(images)), images)


def test_the_pictures_of_the_evaluation(model, prompts):
    out = gradient(guidance(model, eval_steps=2), prompts[True], renders(), guidance_eval=True)[1][
        "eval"
    ]
    for name in ("imgs_noisy", "imgs_1step", "imgs_1orig", "imgs_final"):
        assert out[name].shape == (4, 16, 16, 3)
        assert 0 <= out[name].min() <= out[name].max() <= 1


def test_embeddings_of_another_model_are_refused(model, prompts):
    guide = guidance(model)
    assert (
        guide.text_width == tiny_models.TEXT_WIDTH
    )  # of T5, not of the cross-attention behind its projection
    guide.text_width = 4096
    with pytest.raises(UserError, match="takes 4096"):
        guide(renders(), prompts[False], **BATCH)


def test_the_default_is_gated_which_is_reported_at_once(tmp_path, monkeypatch):
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    assert deep_floyd.DeepFloydGuidance.Config().guidance_scale == 20.0
    with pytest.raises(UserError, match="DeepFloyd/IF-I-XL-v1.0.*HF_HUB_OFFLINE"):
        deep_floyd.DeepFloydGuidance({})


@pytest.mark.skipif(NAME != "builtin", reason="inside threestudio its own part has this name")
def test_threestudios_name_finds_this_packages_part():
    assert find("deep-floyd-guidance") is deep_floyd.DeepFloydGuidance


def test_the_schedule_is_the_models_to_its_last_step(model):
    """IF's cosine schedule ends at 2.4e-9, below the value that replaces a signal of exactly 0."""
    from diffusers import DDPMScheduler

    expected = DDPMScheduler.from_pretrained(model, subfolder="scheduler").alphas_cumprod.double()
    found = guidance(model).alphas_cumprod
    assert found[-1] < 1e-8
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize("variant", ["csd", "nfsd", "vsd", "sdi", "ism", "cfd"])
def test_every_variant_gives_a_gradient(model, prompts, variant):
    surface = {"depth": torch.full((4, 16, 16, 1), 2.0), "opacity": torch.ones(4, 16, 16, 1)}
    cameras = {"c2w": torch.eye(4).repeat(4, 1, 1), "fovy": torch.ones(4)}
    guide = guidance(model, variant_type=f"{variant}-variant")
    plain, _ = gradient(guidance(model), prompts[False], renders())
    grad, out = gradient(guide, prompts[False], renders(), **surface, **cameras)
    assert grad.isfinite().all() and grad.any() and out["bad_items"] == 0
    assert not torch.allclose(grad, plain)
