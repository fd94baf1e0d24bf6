import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer import metrics


def images(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def test_psnr_is_that_of_a_known_error_and_of_torchmetrics():
    a = images(2, 8, 8, 3)
    assert math.isclose(metrics.psnr(a, a + 0.1), 20, abs_tol=1e-4)
    assert metrics.psnr(a, a) == 100
    for value in (math.inf, -math.inf, math.nan, 1e30):  # no picture
        assert metrics.psnr(a, torch.full((2, 8, 8, 3), value)) == -100
    reference = pytest.importorskip("torchmetrics.functional.image")
    a, b = images(2, 20, 30, 3), images(2, 20, 30, 3, seed=1)
    assert_close(metrics.psnr(a, b), reference.peak_signal_noise_ratio(b, a, data_range=1.0))


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_ssim_agrees_with_torchmetrics(noise):
    reference = pytest.importorskip("torchmetrics.functional.image")
    a = images(3, 6, 6, 3).repeat_interleave(8, 1).repeat_interleave(8, 2)
    b = (a + noise * torch.randn(a.shape, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    pair, options = (x.movedim(-1, 1) for x in (b, a)), {"data_range": 1.0, "reduction": "none"}
    expected = reference.structural_similarity_index_measure(*pair, **options)
    # both are float32 with E[x^2] - E[x]^2 against a constant of 9e-4
    assert_close(metrics.ssim(a, b), expected, rtol=0, atol=2e-4)
    assert_close(metrics.ssim(a[0], b[0]), metrics.ssim(a, b)[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("sides", [(6, 7), (11, 30)])
def test_the_window_of_ssim_is_a_gaussian_over_images_padded_by_reflection(sides):
    """Against a sum over each window in NumPy."""
    image = images(*sides, 2).double()
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    padded = np.pad(image.numpy(), ((5, 5), (5, 5), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (11, 11), axis=(0, 1))
    expected = np.einsum("hwcij,ij->hwc", windows, weights / weights.sum())
    np.testing.assert_allclose(metrics._window_mean(image).numpy(), expected, rtol=0, atol=1e-14)


def test_ssim_of_equal_images_is_one_and_small_ones_are_refused():
    a = images(16, 16, 3)
    assert_close(metrics.ssim(a, a), torch.tensor(1.0), rtol=0, atol=1e-5)
    refused("at least 6 pixels", metrics.ssim, a[:5], a[:5])


def test_azimuths_wrap():
    a, b = torch.tensor([350.0, -170.0, 10.0, 0.0]), torch.tensor([10.0, 170.0, 10.0, 540.0])
    assert metrics.azimuth_difference(a, b).tolist() == [20, 20, 0, 180]


def test_multi_face_rate_counts_views_of_the_wrong_side():
    bank, azimuths = images(8, 32, 32, 3), torch.arange(8) * 45.0
    assert metrics.multi_face_rate(bank, bank, azimuths, azimuths) == 0
    everywhere_the_back = bank[4].expand(8, -1, -1, -1)
    # 180 and its two neighbours at 45 are right
    assert metrics.multi_face_rate(everywhere_the_back, bank, azimuths, azimuths) == 5 / 8


def test_floater_mass_is_weighted_by_opacity():
    distances, opacities = torch.tensor([0.0, 0.03, 0.05, 0.1]), torch.tensor([0.5, 0.5, 0.2, 0.8])
    mass = metrics.floater_mass(distances, opacities, extent=2.0)
    assert math.isclose(mass, 0.5)  # farther than 0.04
    assert metrics.floater_mass(distances, torch.zeros(4), extent=2.0) == 0


def test_saturation_is_the_range_of_the_channels():
    images = torch.tensor([[[0.2, 0.9, 0.5], [0.4, 0.4, 0.4]]])
    assert metrics.saturation(images) == pytest.approx(0.35)


def test_out_of_gamut_counts_pixels_beyond_what_a_screen_shows():
    shown = images(2, 5, 10, 3)
    shown[0, 0, :5, 0] = 1.01
    shown[1, 0, :5, 2] = -0.01
    shown[0, 1, 0] = 1 + 1e-4  # rounding of white isn't beyond it
    assert metrics.out_of_gamut(shown) == 10 / 100
