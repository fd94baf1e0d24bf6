"""``.splat`` and ``.ksplat``, which are only read. Axes of both are those of the PLY, -y up.

``.splat``, antimatter15's format, is headerless records without harmonics, with linear scales and
quaternions wxyz as 128 + 128 q.

``.ksplat``, of mkkellogg's GaussianSplats3D, levels 0 to 2: a header, one for each section, then
the sections: the counts of their partly filled buckets, the centres of all buckets, and a record
for each Gaussian, with linear scales, wxyz, and the harmonics above the constant one band by band,
and in a band channel by channel. At levels 1 and 2 numbers are float16, positions are steps from
the centre of the Gaussian's bucket, and at level 2 harmonics are bytes."""

import os

import numpy as np
from jaxtyping import Float

from ..gaussians.gaussians import Gaussians
from ..gaussians.sh import C0, COEFFICIENTS, rgb_to_sh0
from .packing import logits_of_bytes
from .reading import reading, require

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "level", "range"],
        "formats": ["u1", "u1", "<u4", "<u2", ("<f4", 2)],
        "offsets": [0, 1, 4, 20, 36],
        "itemsize": 4096,
    }
)
SECTION = np.dtype(
    {
        "names": "count room bucket buckets block stride steps full partial degree".split(),
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)
NUMBERS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Types of positions, of scales and quaternions, and of harmonics, by level."""
MAX_DEGREE = 2


def read_splat(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read a ``.splat`` file, which has no notes; rows with values that aren't finite are kept.

    Raises:
        UserError: there is no such file, it is empty, or its size isn't a multiple of 32 bytes.
    """
    with reading(path, ".splat file") as file:
        size = file.stat().st_size
        said = f"its size should be a multiple of {RECORD.itemsize} bytes, one record a Gaussian"
        usual = size > 0 and size % RECORD.itemsize == 0
        require(usual, f"{said}, not {size}: it is truncated or of another format")
        rows = np.fromfile(file, RECORD)
        colors = (rows["rgba"][:, :3] / np.float32(255) - np.float32(0.5)) / np.float32(C0)
        gaussians = Gaussians(
            means=rows["mean"].astype(np.float32),
            quats=(rows["quat"].astype(np.float32) - 128) / 128,
            log_scales=np.log(rows["scale"]).astype(np.float32),
            logit_opacities=logits_of_bytes(rows["rgba"][:, 3]),
            sh=colors[:, None],
        )
        return gaussians, []


def read_ksplat(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read a ``.ksplat`` file, which has no notes; rows with values that aren't finite are kept.

    Raises:
        UserError: there is no such file, or it is damaged or of another version.
    """
    with reading(path, ".ksplat file") as file:
        data = np.fromfile(file, np.uint8)
        header = _rows(data, HEADER, 0, 1)[0]
        major, minor, level = (header[name] for name in ("major", "minor", "level"))
        said = f"not version {major}.{minor} and level {level}"
        usual = major == 0 and minor >= 1 and level in range(len(NUMBERS))
        require(usual, f"version 0.1 and level 0, 1 or 2 were expected, {said}")
        sections = _rows(data, SECTION, HEADER.itemsize, int(header["sections"]))
        degree = sections["degree"].max(initial=0)
        require(degree <= MAX_DEGREE, f"harmonics of degree {degree}; expected 0 to {MAX_DEGREE}")
        require(len(sections) > 0, "it has no Gaussians")
        at, found = HEADER.itemsize + sections.nbytes, []
        for values in sections.tolist():
            section = dict(zip(SECTION.names, values, strict=True))
            position, number, harmonic = NUMBERS[level]
            fields = [("mean", position, 3), ("scale", number, 3), ("quat", number, 4)]
            rest = 3 * (COEFFICIENTS[section["degree"]] - 1)
            record = np.dtype([*fields, ("rgba", "u1", 4), ("sh", harmonic, rest)])
            buckets = 4 * section["partial"] + section["stride"] * section["buckets"]
            rows = _rows(data, record, at + buckets, section["count"])
            means = rows["mean"] if level == 0 else _positions(rows["mean"], data, section, at)
            scales = rows["scale"].astype(np.float32)
            scales[scales == 0] = 2**-25  # the largest scale that is 0 as float16
            gaussians = Gaussians(
                means=means.astype(np.float32),
                quats=rows["quat"].astype(np.float32),
                log_scales=np.log(scales),
                logit_opacities=logits_of_bytes(rows["rgba"][:, 3]),
                sh=_harmonics(rows, header, COEFFICIENTS[degree]),
            )
            found.append(gaussians)
            at += buckets + section["room"] * record.itemsize
        return Gaussians(*(np.concatenate(values) for values in zip(*found, strict=True))), []


def _rows(data: np.ndarray, kind: np.dtype, at: int, count: int) -> np.ndarray:
    """Return ``count`` values of a type from the byte ``at`` on."""
    end = at + count * kind.itemsize
    require(end <= len(data), f"it ends after {len(data)} bytes instead of {end}")
    return data[at:end].view(kind)


def _positions(
    steps: np.ndarray, data: np.ndarray, section: dict[str, float], at: int
) -> Float[np.ndarray, "N 3"]:
    """Return positions from steps around the centres of buckets."""
    partly = _rows(data, np.dtype("<u4"), at, section["partial"])
    centers = _rows(data, np.dtype("<f4"), at + partly.nbytes, 3 * section["buckets"])
    held = section["full"] * section["bucket"] + int(partly.sum(dtype=np.int64))
    usual = section["full"] + section["partial"] == section["buckets"]
    usual = usual and section["stride"] == 3 * centers.itemsize and held == len(steps)
    require(usual, f"its buckets hold {held} of the {len(steps)} Gaussians: it is damaged")
    sizes = np.concatenate([np.full(section["full"], section["bucket"], np.int64), partly])
    far = section["steps"] or 32767  # steps from a bucket's centre to its side
    offsets = (steps.astype(np.float64) - far) * (section["block"] / 2 / far)
    return offsets + np.repeat(centers.reshape(-1, 3), sizes, axis=0)


def _harmonics(rows: np.ndarray, header: np.void, count: int) -> Float[np.ndarray, "N K 3"]:
    sh = np.zeros((len(rows), count, 3), np.float32)
    sh[:, 0] = rgb_to_sh0(rows["rgba"][:, :3] / np.float32(255))
    values = rows["sh"].astype(np.float32)
    if header["level"] == 2:
        low, high = (
            said or usual for said, usual in zip(header["range"], (-1.5, 1.5), strict=True)
        )
        values = low + (high - low) * (values / 255)
    for start, end in ((1, 4), (4, 9)):
        if values.shape[1] >= 3 * (end - 1):
            band = values[:, 3 * (start - 1) : 3 * (end - 1)].reshape(len(rows), 3, -1)
            sh[:, start:end] = band.swapaxes(1, 2)
    return sh
