"""The size of images for a text-to-image model."""

from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F

from threestudio_gaussiandreamer.guidance import text_to_image
from threestudio_gaussiandreamer.guidance.text_to_image import TextToImageDistillation, resized


def test_halving_is_the_mean_of_four_pixels_and_more_loses_none():
    images = torch.rand(2, 3, 128, 128)
    torch.testing.assert_close(resized(images, 64), F.avg_pool2d(images, 2))
    images = torch.rand(1, 3, 256, 256, requires_grad=True)
    (grad,) = torch.autograd.grad(resized(images, 16).sum(), images)
    assert (grad > 0).all()


@pytest.mark.parametrize(
    "height, width, warned", [(64, 64, False), (16, 16, False), (15, 64, True), (4, 4, True)]
)
def test_renders_that_become_blurred_are_told_once(caplog, height, width, warned):
    text_to_image._warn_of_small_renders.cache_clear()
    for _ in range(2):
        assert resized(torch.rand(1, 3, height, width), 64).shape == (1, 3, 64, 64)
    told = f"renders of {width} x {height} are enlarged to the 64 x 64"
    assert caplog.text.count(told) == warned


@pytest.mark.parametrize(
    "wanted, found, warned", [(None, 128, False), (128, 128, False), (256, 256, True)]
)
def test_another_size_than_that_of_the_training_is_told(caplog, wanted, found, warned):
    cfg = SimpleNamespace(image_size=wanted, pretrained_model_name_or_path="a model")
    part = SimpleNamespace(
        cfg=cfg, denoiser=SimpleNamespace(config=SimpleNamespace(sample_size=16))
    )
    assert TextToImageDistillation.size_of_images(part, 8) == found
    assert ("a model was trained on images of 128 x 128" in caplog.text) == warned
