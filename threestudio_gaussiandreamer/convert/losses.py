"""What a cloud loses when it is written in a format: in sentences, and in dB of renders of the file
that is read back."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..formats.compressed_ply import MAX_STORED_LOG, SH_REACH
from ..formats.gaussian_files import StoredCloud
from ..formats.sog import palette_size
from ..formats.spz import (
    COLOR_REACH,
    MIN_LOG_SCALE,
    SPZ_UP,
    STEPS_PER_SIZE,
    ZSTD_VERSION,
    out_of_range,
    position_step,
)
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.gaussians import Gaussians
from ..gaussians.views import Views, render_all, views_around
from ..metrics import psnr

VIEWS = 8

ROUNDING = {
    ".spz": "scales are rounded to 6 %, opacities and colours to 8 bits, rotations to 10",
    ".compressed.ply": "positions and scales are rounded to 10 or 11 bits in chunks of 256, "
    "opacities and colours to 8 bits, rotations to 10",
    ".sog": "positions are rounded to 16 bits, scales and colours to 256 values each, opacities "
    "and rotations to 8 bits",
}
HARMONICS = {
    ".spz": "harmonics above degree 0 are rounded to 5 bits (degree 1) and 4",
    ".compressed.ply": "harmonics above degree 0 are rounded to 8 bits",
}


def losses(cloud: StoredCloud, suffix: str, spz_version: int) -> Iterator[str]:
    """Yield a sentence for each loss of a format; none for formats that store float32.

    Args:
        suffix: the format, a key of ``formats.gaussian_files.FORMATS``.
    """
    suffix = ".spz" if suffix == ".spz.glb" else suffix
    if suffix in ROUNDING:
        yield ROUNDING[suffix]
    if cloud.gaussians.sh_degree and suffix in HARMONICS:
        yield HARMONICS[suffix]
    yield from {".spz": _of_spz, ".compressed.ply": _of_compressed_ply, ".sog": _of_sog}.get(
        suffix, lambda cloud: ()
    )(cloud)
    if suffix == ".spz" and spz_version == ZSTD_VERSION and cloud.pruned_to is not None:
        yield "the note about pruning: SPZ of version 4 has no place for it"


def dropped(whole: StoredCloud, kept: StoredCloud) -> Iterator[str]:
    """Yield a sentence for each loss of a cloud whose degree is reduced on purpose."""
    if kept.gaussians.sh_degree < whole.gaussians.sh_degree:
        yield f"harmonics above degree {kept.gaussians.sh_degree}"
        if whole.pruned_to is not None:
            yield "the note about pruning, which is for all harmonics"


def _counted(rows: np.ndarray, what: str) -> Iterator[str]:
    """Yield "n of N Gaussians ``what``" if n > 0; a Gaussian counts if any of its row is true."""
    count = int(rows.reshape(len(rows), -1).any(axis=1).sum())
    if count:
        yield f"{count:,} of {len(rows):,} Gaussians {what}"


def _of_spz(cloud: StoredCloud) -> Iterator[str]:
    gaussians = cloud.in_axes(SPZ_UP).gaussians
    yield _rounded_positions(gaussians)
    yield from _counted(out_of_range(gaussians), "are farther away or larger than it holds")
    small = gaussians.log_scales < MIN_LOG_SCALE - 1 / 32
    yield from _counted(small, "are smaller than e^-10 along an axis, and become that large")
    beyond = np.abs(gaussians.sh[:, 0]) > COLOR_REACH
    yield from _counted(beyond, "have colours beyond -0.44 to 1.44, which are clipped")
    yield from _counted(np.abs(gaussians.sh[:, 1:]) > 1, "have harmonics beyond 1, clipped")


def _rounded_positions(gaussians: Gaussians) -> str:
    step, size = position_step(gaussians), np.exp(np.median(gaussians.log_scales.mean(axis=1)))
    if step <= size / STEPS_PER_SIZE:
        return f"positions are rounded to 1/{STEPS_PER_SIZE} of the median size"
    reach, share = np.abs(gaussians.means).max(), step / size
    return f"positions up to {reach:g} are rounded to {step:g}, {share:.2g} of the median size"


def _of_compressed_ply(cloud: StoredCloud) -> Iterator[str]:
    gaussians = cloud.gaussians
    beyond = np.abs(gaussians.sh[:, 1:]) > SH_REACH
    yield from _counted(beyond, f"have harmonics beyond {SH_REACH:g}, clipped")
    large = np.abs(gaussians.log_scales) > MAX_STORED_LOG
    yield from _counted(large, "are smaller than e^-20 or larger than e^20, and clipped")


def _of_sog(cloud: StoredCloud) -> Iterator[str]:
    count = len(cloud.gaussians.means)
    if cloud.gaussians.sh_degree and (entries := palette_size(count)) < count:
        yield f"harmonics above degree 0 come from a palette of {entries:,} for {count:,} Gaussians"


# ---- dB ------------------------------------------------------------------------------------------


@torch.no_grad()
def reference(before: StoredCloud, size: int) -> tuple[str, Views, Float[Tensor, "V H W 3"]]:
    """Render a cloud from ``VIEWS`` directions around it, with or without antialiasing as it was
    trained; return its up axis, the views and the images.

    Args:
        size: width and height of the images, pixels.

    Raises:
        UserError: the cloud is too large to be rendered.
    """
    cloud = before.gaussians.tensors()
    to_z_up = torch.from_numpy(rotation_between(before.up, WORLD_UP))
    views = views_around(cloud, VIEWS, size, to_z_up=to_z_up)
    views = views._replace(antialias=before.antialiased)
    return before.up, views, render_all(cloud, views)


@torch.no_grad()
def compare(
    truth: tuple[str, Views, Float[Tensor, "V H W 3"]], after: StoredCloud
) -> tuple[float, float]:
    """Render a cloud as :func:`reference` did; return the PSNR of the images to those before, dB:
    over all pixels of all views, and of the worst view.
    """
    up, views, images = truth
    found = render_all(after.in_axes(up).gaussians.tensors(), views)
    worst = min(float(psnr(*pair)) for pair in zip(found, images, strict=True))
    return float(psnr(found, images)), worst
