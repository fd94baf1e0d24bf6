"""Image to image against score models whose pictures are known."""

import pytest
import torch

from tests.helpers.pixel_guidance import PixelGuidance
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.diffusion.sds import per_item
from threestudio_gaussiandreamer.guidance.image_to_image import image_to_image

GREY = 0.25


class KnowsOnePicture(PixelGuidance):
    """The score of a single picture, whose pixels are GREY."""

    def predict(self, z, t, condition):
        self.evaluations += len(z)
        abar = per_item(self.abar_of(t), z)
        return (z - abar.sqrt() * (2 * GREY - 1)) / (1 - abar).sqrt(), None


class GaussianPixels(PixelGuidance):
    """The score of independent pixels with mean 0 and standard deviation SPREAD."""

    SPREAD = 0.3

    def predict(self, z, t, condition):
        abar = per_item(self.abar_of(t), z)
        return (1 - abar).sqrt() * z / (abar * self.SPREAD**2 + 1 - abar), None


class BetweenTwo(PixelGuidance):
    """The conditional picture is 0.5, the unconditional one 0.25."""

    def predict(self, z, t, condition):
        abar = per_item(self.abar_of(t), z)
        return tuple((z - abar.sqrt() * (2 * grey - 1)) / (1 - abar).sqrt() for grey in (0.5, GREY))


class HalfSize(KnowsOnePicture):
    def encode(self, rgb, **batch):
        return torch.nn.functional.avg_pool2d(2 * rgb - 1, 2)


def draw(guidance, rgb, **options):
    return image_to_image(guidance, rgb, None, **{"guidance_scale": 1.0, **options})


@pytest.mark.parametrize("strength, steps", [(0.3, 1), (0.7, 4), (1.0, 8)])
def test_the_only_picture_that_the_model_knows_is_drawn(strength, steps):
    guidance, rgb = KnowsOnePicture({}), torch.rand(3, 8, 8, 3)
    drawn = draw(guidance, rgb, strength=strength, num_inference_steps=steps)
    assert torch.allclose(drawn, torch.full_like(rgb, GREY), atol=1e-4)
    assert guidance.evaluations == 3 * steps


@pytest.mark.parametrize("strength", [0.0, 0.002])
def test_with_hardly_any_noise_the_pictures_stay(strength):
    rgb = torch.rand(2, 8, 8, 3)
    drawn = draw(GaussianPixels({}), rgb, strength=strength, num_inference_steps=30)
    assert torch.allclose(drawn, rgb, atol=0.15)  # the first timesteps have a little noise


def test_all_noise_gives_a_sample_of_the_model():
    rgb = torch.ones(4, 64, 64, 3)
    drawn = 2 * draw(GaussianPixels({}), rgb, strength=1.0, num_inference_steps=200) - 1
    assert float(drawn.std()) == pytest.approx(GaussianPixels.SPREAD, rel=0.05)
    left = float(sds.sd_alphas_cumprod()[-1].sqrt())  # of the white picture, at the last timestep
    assert abs(float(drawn.mean())) < left + 0.02


def test_a_step_draws_the_same_pictures_again_and_another_step_others():
    guidance, rgb = GaussianPixels({}), torch.rand(2, 8, 8, 3)
    how = {"strength": 0.5, "num_inference_steps": 2}
    first = draw(guidance, rgb, **how)
    assert torch.equal(first, draw(guidance, rgb, **how))
    guidance.update_step(0, 1)
    assert not torch.allclose(first, draw(guidance, rgb, **how))


def test_pictures_have_the_models_size_and_no_gradient():
    rgb = torch.rand(1, 8, 12, 3, requires_grad=True)
    drawn = draw(HalfSize({}), rgb, strength=0.5, num_inference_steps=2)
    assert drawn.shape == (1, 4, 6, 3) and not drawn.requires_grad


def test_the_scale_is_that_of_the_call():
    """Guided predictions of these two pictures are those of one beyond them."""
    guidance = BetweenTwo({"guidance_scale": 50.0})
    rgb, how = torch.rand(1, 4, 4, 3), {"strength": 0.6, "num_inference_steps": 3}
    for scale, expected in ((1.0, 0.5), (2.0, 0.75), (3.0, 1.0)):
        drawn = draw(guidance, rgb, guidance_scale=scale, **how)
        assert torch.allclose(drawn, torch.full_like(rgb, expected), atol=1e-4)
