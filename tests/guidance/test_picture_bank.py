import pytest
import torch

from threestudio_gaussiandreamer.diffusion import exact_score
from threestudio_gaussiandreamer.guidance.known_truth import composite
from threestudio_gaussiandreamer.guidance.picture_bank import Bank, mixture_of

MEMBERS = torch.tensor([True, True, False, True, False, True, True])


@pytest.fixture
def bank():
    generator = torch.Generator().manual_seed(0)
    rgba = torch.randint(0, 256, (7, 8, 8, 4), generator=generator, dtype=torch.uint8)
    pooled = torch.nn.functional.avg_pool2d(rgba.movedim(-1, 1) / 255, 2)
    matrix = exact_score.color_matrix(4)
    return Bank(rgba, pooled, exact_score.LinearLatent(2, matrix).normalised(pooled[:, :3]))


@pytest.mark.parametrize("size", [1, 8])
@pytest.mark.parametrize("own_views", [None, 0, 2])
@pytest.mark.parametrize("pictures_at_a_time", [1, 2, 100])
def test_modes_are_the_own_views_and_the_marked_pictures(
    bank, monkeypatch, size, own_views, pictures_at_a_time
):
    monkeypatch.setattr(exact_score, "CPU_CHUNK_ELEMENTS", pictures_at_a_time * 8 * 8 * 4)
    background = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(1))
    own = None if own_views is None else torch.ones(own_views, 4, 4, 4)
    mixture = mixture_of(own, bank, MEMBERS, background)
    pictures = bank.latent.encode(composite(bank.rgba[MEMBERS], background[None]))
    expected = pictures if own is None else torch.cat([own, pictures])
    torch.testing.assert_close(mixture.modes, expected, rtol=0, atol=1e-5)
    norms = mixture.modes.flatten(1).double().square().sum(1)
    torch.testing.assert_close(mixture.norms, norms, rtol=1e-14, atol=0)
    assert mixture.log_prior is None
