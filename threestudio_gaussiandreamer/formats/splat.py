"""``.splat``, antimatter15's headerless records of 32 bytes: read only, since it has no harmonics
and less precision than any format that is written here.

A record is position and scale (3 float32 each, the scale linear), colour and opacity (4 bytes) and
the quaternion wxyz (4 bytes, 128 + 128 q). Axes are those of 3D Gaussian splatting's PLY, -y up."""

import os

import numpy as np

from ..core.errors import UserError
from ..core.files import existing_file
from ..gaussians.gaussians import Gaussians
from ..gaussians.sh import C0
from .packing import logits_of_bytes

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read_splat(path: str | os.PathLike) -> Gaussians:
    """Read a ``.splat`` file; rows with values that aren't finite are kept.

    Raises:
        UserError: there is no such file, it is empty, or its size isn't a multiple of 32 bytes.
    """
    path = existing_file(path, ".splat file")
    size = path.stat().st_size
    if size == 0 or size % RECORD.itemsize:
        raise UserError(
            f".splat file {str(path)!r}: its size should be a multiple of {RECORD.itemsize} bytes, "
            f"one record a Gaussian, not {size}: it is truncated or of another format"
        )
    rows = np.fromfile(path, RECORD)
    colors = (rows["rgba"][:, :3] / np.float32(255) - np.float32(0.5)) / np.float32(C0)
    with np.errstate(divide="ignore", invalid="ignore"):  # of scales that are 0 or negative
        log_scales = np.log(rows["scale"])
    return Gaussians(
        means=rows["mean"].astype(np.float32),
        quats=(rows["quat"].astype(np.float32) - 128) / 128,
        log_scales=log_scales.astype(np.float32),
        logit_opacities=logits_of_bytes(rows["rgba"][:, 3]),
        sh=colors[:, None],
    )
