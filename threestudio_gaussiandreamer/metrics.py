"""Metrics: PSNR, SSIM, multi-face rate, floater mass, share of colours out of gamut."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from .core.errors import UserError

MAX_PSNR = 100.0
SSIM_WINDOW = 11
SMALLEST_SIDE = SSIM_WINDOW // 2 + 1
"""Of images for :func:`ssim`, which are padded by reflection, pixels."""


def psnr(image: Float[Tensor, "*shape"], truth: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Compute -10 log10 of the mean squared error over all elements, for images in [0, 1], in dB,
    clamped to [-100, 100]; an error that isn't finite gives -100 dB.
    """
    return psnr_of_error((image - truth).square().mean())


def psnr_of_error(mean_square: Float[Tensor, ""]) -> Float[Tensor, ""]:
    """Compute the result of :func:`psnr` from the mean squared error."""
    error = mean_square.nan_to_num(nan=torch.inf)
    return -10 * error.clamp(10 ** (-MAX_PSNR / 10), 10 ** (MAX_PSNR / 10)).log10()


def ssim(
    image: Float[Tensor, "*batch H W C"], truth: Float[Tensor, "*batch H W C"]
) -> Float[Tensor, "*batch"]:
    """Compute the structural similarity of pairs of images in [0, 1] (Wang et al. 2004, eq. 13).

    The window is an 11 x 11 Gaussian with sigma 1.5, images are padded by reflection, K1 is 0.01
    and K2 0.03, and the mean is over pixels and channels, as in torchmetrics' defaults. Raises
    UserError for a side of fewer pixels than SMALLEST_SIDE.
    """
    if min(image.shape[-3:-1]) < SMALLEST_SIDE:
        found = tuple(image.shape[-3:-1])
        raise UserError(f"SSIM needs images of at least {SMALLEST_SIDE} pixels a side, not {found}")
    mean_x, mean_y = _window_mean(image), _window_mean(truth)
    var_x = _window_mean(image**2) - mean_x**2
    var_y = _window_mean(truth**2) - mean_y**2
    covariance = _window_mean(image * truth) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (var_x + var_y + c2)
    return (luminance * structure).mean(dim=(-3, -2, -1))


MULTI_FACE_NOTE = (
    "multi-face says nothing of an object whose sides look alike, such as a ball or a box"
)


def multi_face_rate(
    renders: Float[Tensor, "V H W 3"],
    bank_images: Float[Tensor, "K h w 3"],
    view_azimuths: Float[Tensor, " V"],
    bank_azimuths: Float[Tensor, " K"],
    *,
    threshold: float = 45.0,
    size: int = 32,
) -> float:
    """Compute the fraction of views whose most similar bank image is from an azimuth more than
    ``threshold`` degrees away.

    Similarity is the squared error at ``size`` x ``size`` pixels, so both sets of images need the
    same background, and for a reliable rate the same elevations and distances.

    Args:
        renders, view_azimuths: images of the Gaussians, in [0, 1], and their azimuths, degrees.
        bank_images, bank_azimuths: those of the known object, of any size.
    """
    sets = (images.movedim(-1, 1) for images in (renders, bank_images.to(renders)))
    views, bank = (F.adaptive_avg_pool2d(images, (size, size)).flatten(1) for images in sets)
    nearest = torch.cdist(views, bank).argmin(dim=1).to(view_azimuths.device)
    apart = azimuth_difference(view_azimuths, bank_azimuths.to(view_azimuths)[nearest])
    return (apart > threshold).double().mean().item()


def azimuth_difference(a: Float[Tensor, "*n"], b: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the angle between two azimuths in degrees, in [0, 180]."""
    return ((a - b + 180) % 360 - 180).abs()


def floater_mass(
    distances: Float[Tensor, " N"],
    opacities: Float[Tensor, " N"],
    *,
    extent: float,
    share: float = 0.02,
) -> float:
    """Compute the fraction of Gaussians, weighted by opacities in [0, 1], whose distances from the
    surface exceed ``share`` of ``extent``, the longest side of the object's box, in world units.
    """
    total = opacities.sum()
    return (opacities[distances > share * extent].sum() / total).item() if total > 0 else 0.0


def out_of_gamut(images: Float[Tensor, "*batch 3"]) -> float:
    """Compute the fraction of pixels with a channel more than half a grey level outside [0, 1]."""
    beyond = 0.5 / 255
    return ((images < -beyond) | (images > 1 + beyond)).any(-1).double().mean().item()


def saturation(images: Float[Tensor, "*batch 3"]) -> float:
    """Compute the mean saturation of colours in [0, 1]: the largest channel minus the smallest."""
    return (images.amax(-1) - images.amin(-1)).double().mean().item()


def _window_mean(images: Float[Tensor, "*batch H W C"]) -> Float[Tensor, "*batch H W C"]:
    """Compute the Gaussian-weighted mean of the window around each pixel, one axis at a time: a sum
    of shifted images, which on a CPU takes less time than a convolution of one channel.
    """
    half = SSIM_WINDOW // 2
    offsets = torch.arange(-half, half + 1, dtype=torch.float64)
    weights = torch.softmax(-(offsets**2) / (2 * 1.5**2), dim=0)
    for dim in (-3, -2):
        size = images.shape[dim]
        places = torch.arange(-half, size + half, device=images.device).abs()
        padded = images.index_select(dim, torch.minimum(places, 2 * (size - 1) - places))
        mean = torch.zeros_like(images)
        for start, weight in enumerate(weights.tolist()):
            mean.add_(padded.narrow(dim, start, size), alpha=weight)
        images = mean
    return images
