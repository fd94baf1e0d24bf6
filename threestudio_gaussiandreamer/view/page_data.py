"""Pack Gaussians for a page: the columns of a PLY file as byte planes, compressed.

The float32 values are kept to the bit, so that the page can save the PLY file. Each column is
stored as four planes (the lowest bytes of all values, then the next ones, ...), since signs and
exponents repeat and the lowest bytes don't."""

import zlib

import numpy as np

from ..formats.ply import NORMALS, gaussian_columns, gaussian_properties
from ..gaussians.gaussians import Gaussians

LEVEL = 6
COARSE_MEANS = 1024
"""Steps of coarse positions along the longest side of the cloud."""
COARSE_LOG_SCALE, COARSE_SH, COARSE_QUAT, COARSE_LOGIT = 1 / 8, 1 / 16, 1 / 32, 1 / 8
"""Steps of the other coarse attributes; that of the harmonics is 4.5 levels of 255 of a colour."""


def packed(gaussians: Gaussians) -> bytes:
    """Compress the columns of N Gaussians (arrays), except the normals, which are zero."""
    names = [name for name, _ in gaussian_properties(gaussians.sh.shape[1])]
    stored = [number for number, name in enumerate(names) if name not in NORMALS]
    columns = np.ascontiguousarray(gaussian_columns(gaussians)[:, stored].T, dtype="<f4")
    planes = columns.view(np.uint8).reshape(*columns.shape, 4).transpose(0, 2, 1)
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), LEVEL)


def coarse(gaussians: Gaussians) -> Gaussians:
    """Round the attributes of a cloud that is shown for comparison only, and drop its harmonics
    above degree 0. The rounded values are multiples of powers of two, whose lowest bytes are zero
    and vanish when packed.
    """
    side = float(np.ptp(gaussians.means, axis=0).max(initial=0))
    step = 2.0 ** np.ceil(np.log2(max(side, 1e-30) / COARSE_MEANS))
    return Gaussians(
        means=_rounded(gaussians.means, step),
        quats=_rounded(gaussians.quats, COARSE_QUAT),
        log_scales=_rounded(gaussians.log_scales, COARSE_LOG_SCALE),
        logit_opacities=_rounded(gaussians.logit_opacities, COARSE_LOGIT),
        sh=_rounded(gaussians.sh[:, :1], COARSE_SH),
    )


def _rounded(values: np.ndarray, step: float) -> np.ndarray:
    return (np.rint(values / step) * step).astype(np.float32)
