"""The modes of the exact score's mixtures."""

import pytest
import torch

from tests.diffusion.test_exact_score import denoised
from threestudio_gaussiandreamer.diffusion import exact_score, sds
from threestudio_gaussiandreamer.guidance.picture_bank import Bank, composite, mixture_of, scores

MEMBERS = torch.tensor(
    [[True, True, False, True, False, True, True], [False] * 6 + [True], [True] * 7]
)
"""Of each item, in the bank."""
ABAR = sds.sd_alphas_cumprod()[torch.tensor([20, 300, 900])]


def uniform(*shape, seed):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(params=["pixel", "latent"])
def bank(request):
    rgba = (255 * uniform(7, 8, 8, 4, seed=0)).byte()
    pixels = rgba.movedim(-1, 1) / 255
    if request.param == "pixel":
        return Bank.of(rgba, pixels, exact_score.LinearLatent())
    pooled = torch.nn.functional.avg_pool2d(pixels, 2)
    latent = exact_score.LinearLatent(2, exact_score.COLOR_MATRIX)
    return Bank.of(rgba, pooled, latent.normalised(pooled[:, :3]))


def predicted(mixtures, z, abar, conditional):
    eps, perplexity, unconditional = scores(z.flatten(1), abar, mixtures)
    return (eps, perplexity) if conditional else (unconditional(), None)


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("size, pictures_at_a_time", [(1, 100), (1, 3), (8, 1)])
def test_scores_are_those_of_pictures_composited_on_the_background_of_each_item(
    bank, monkeypatch, size, guided, pictures_at_a_time
):
    elements = bank.pictures.layers[0].numel()
    monkeypatch.setattr(exact_score, "CPU_CHUNK_ELEMENTS", pictures_at_a_time * elements)
    backgrounds = uniform(len(MEMBERS), size, size, 3, seed=1)
    z = bank.latent.encode(composite(bank.rgba[: len(MEMBERS)], backgrounds)) + 0.1
    own = z.flip(0)
    items = zip(own, MEMBERS, backgrounds, strict=True)
    mixtures = [mixture_of(*item, bank, guided) for item in items]
    of_a_color = size == 1  # whose items have the same pictures
    for conditional in (True, False) if guided else (True,):
        together = predicted(mixtures, z, ABAR, conditional) if of_a_color else None
        for i in range(len(MEMBERS)):
            item = slice(i, i + 1)
            pictures = bank.rgba[MEMBERS[i]] if conditional else bank.rgba
            modes = bank.latent.encode(composite(pictures, backgrounds[item]))
            modes = torch.cat([own[item], modes])
            alone = predicted(mixtures[item], z[item], ABAR[item], conditional)
            expected = denoised(z[item].flatten(1).double(), ABAR[item], modes.flatten(1).double())
            for found in (alone, together and [None if x is None else x[item] for x in together]):
                if found is not None:
                    torch.testing.assert_close(found[0].double(), expected[0], rtol=0, atol=1e-4)
                    if conditional:
                        torch.testing.assert_close(found[1], expected[1], rtol=1e-3, atol=0)
