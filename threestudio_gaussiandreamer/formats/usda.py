"""USDA text of one ParticleField3DGaussianSplat prim, the Gaussians of OpenUSD from 26.03 on, for
Omniverse, Houdini and other programs of film and simulation. Needs no USD library; the reader is
``usda_reader.py``.

Scales and opacities are linear, quaternions (w, x, y, z), coefficients of a Gaussian one after the
other, all float32 with 9 digits. Axes: y up, front +z; one unit is one metre. USD has no attribute
for antialiasing: it and the notes are in the layer's ``customLayerData``."""

import os
import struct
import zipfile
from collections.abc import Iterator, Sequence
from typing import BinaryIO

import numpy as np

from ..core.errors import UserError
from ..core.files import atomic_file
from ..gaussians.gaussians import Gaussians, finite
from .packing import opacities, unit_quats

USDA_UP = "y"
MAGIC, PRIM, SCHEMA = "#usda 1.0", "Gaussians", "ParticleField3DGaussianSplat"
DEGREE = "radiance:sphericalHarmonicsDegree"
HARMONICS = "radiance:sphericalHarmonicsCoefficients"
COLORS = "primvars:displayColor"
"""Read where there are no harmonics."""
TYPES = {
    "positions": "point3f[]",
    "orientations": "quatf[]",
    "scales": "float3[]",
    "opacities": "float[]",
    DEGREE: "int",
    HARMONICS: "float3[]",
    COLORS: "color3f[]",
}
"""Of the prim's attributes."""
REACH = 3.0
"""Standard deviations of a Gaussian that the prim's extent contains."""
LAYER, ALIGNMENT, ZIP_HEADER = "gaussians.usda", 64, 30
"""Of a USDZ: the name of its layer, the alignment of its content, and the size of the header before
the name.
"""
PADDING, PADDING_ID = struct.Struct("<HH"), 0x1986
"""The extra field that aligns the content, and OpenUSD's mark of it."""
ROWS = 4096
"""Values that are formatted at once."""


def write_usda(path: str | os.PathLike, gaussians: Gaussians, notes: Sequence[str] = ()) -> None:
    """Write a USDA file atomically, without Gaussians that can't be drawn.

    Args:
        gaussians: with y up.
        notes: ASCII lines for the layer's custom data, without quotes and backslashes.

    Raises:
        UserError: harmonics above degree 3, or the file can't be written.
    """
    gaussians = finite(gaussians, str(path))
    with atomic_file(path) as file:
        _write_layer(file, gaussians, notes)


def write_usdz(path: str | os.PathLike, gaussians: Gaussians, notes: Sequence[str] = ()) -> None:
    """Write a USDZ, which phones open: a zip archive of one USDA layer, not compressed, whose
    content begins at a multiple of 64 bytes. Arguments and errors are those of :func:`write_usda`,
    and the layer may have 2 GiB at most.
    """
    gaussians = finite(gaussians, str(path))
    layer = zipfile.ZipInfo(LAYER)  # without a date, so that files are reproducible
    padding = -(ZIP_HEADER + len(LAYER) + PADDING.size) % ALIGNMENT
    layer.extra = PADDING.pack(PADDING_ID, padding) + bytes(padding)
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        try:
            with archive.open(layer, "w") as content:
                _write_layer(content, gaussians, notes)
        except RuntimeError as error:
            raise UserError(f"{str(path)!r}: a USDZ may have 2 GiB at most ({error})") from error


def _write_layer(file: BinaryIO, gaussians: Gaussians, notes: Sequence[str]) -> None:
    file.write(_head(gaussians, notes).encode("ascii"))
    for array in _arrays(gaussians):
        _write_array(file, *array)
    file.write(b"}\n")


def _head(gaussians: Gaussians, notes: Sequence[str]) -> str:
    said = ", ".join(f'"{note}"' for note in notes)
    custom = f"    customLayerData = {{\n        string[] notes = [{said}]\n    }}\n"
    return (
        f'{MAGIC}\n(\n{custom if notes else ""}    defaultPrim = "{PRIM}"\n'
        f'    metersPerUnit = 1\n    upAxis = "{USDA_UP.upper()}"\n)\n\n'
        f'def {SCHEMA} "{PRIM}"\n{{\n'
        f"    float3[] extent = [{', '.join(map(_tuple, _extent(gaussians)))}]\n"
        f"    uniform {TYPES[DEGREE]} {DEGREE} = {gaussians.sh_degree}\n"
    )


def _arrays(gaussians: Gaussians) -> Iterator[tuple[str, np.ndarray, str]]:
    """Yield name, values and metadata of each array; scalars as (N,)."""
    harmonics = gaussians.sh.shape[1]
    sh = gaussians.sh.reshape(len(gaussians.sh) * harmonics, 3)
    yield "positions", gaussians.means, ""
    yield "orientations", unit_quats(gaussians.quats).astype(np.float32), ""
    yield "scales", np.exp(gaussians.log_scales), ""
    yield "opacities", opacities(gaussians.logit_opacities).astype(np.float32), ""
    layout = f'elementSize = {harmonics}\n        interpolation = "vertex"'
    yield HARMONICS, sh, layout


def _write_array(file: BinaryIO, name: str, values: np.ndarray, metadata: str) -> None:
    file.write(f"    {TYPES[name]} {name} = [".encode())
    for at in range(0, len(values), ROWS):
        rows = map(_tuple, values[at : at + ROWS])
        file.write((", " if at else "").encode() + ", ".join(rows).encode())
    file.write(f"] (\n        {metadata}\n    )\n".encode() if metadata else b"]\n")


def _tuple(value: np.ndarray) -> str:
    if value.ndim == 0:
        return f"{value:.9g}"
    return f"({', '.join(f'{number:.9g}' for number in value)})"


def _extent(gaussians: Gaussians) -> np.ndarray:
    """Return the corners of the box that holds the Gaussians, (2, 3)."""
    if not len(gaussians.means):
        return np.zeros((2, 3), np.float32)
    reach = REACH * np.exp(gaussians.log_scales.max(axis=1, keepdims=True).astype(np.float64))
    corners = [(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)]
    return np.clip(np.stack(corners), -3e38, 3e38).astype(np.float32)
