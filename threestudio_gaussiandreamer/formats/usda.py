"""USDA text of one ParticleField3DGaussianSplat prim, the Gaussians of OpenUSD from 26.03 on.

Scales and opacities are linear, quaternions (w, x, y, z), coefficients of a Gaussian one after the
other, all float32 with 9 digits; y up, front +z; one unit is one metre. Antialiasing and the notes
are in the layer's ``customLayerData``. Text of one such prim, with a line for each attribute, also
inside a USDZ, is read and written without a library; all else is read by OpenUSD where it is
installed. Other attributes and the unit of the layer are ignored."""

import io
import os
import re
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError
from ..core.files import atomic_file
from ..gaussians.axes import placed, rotate, rotation_between
from ..gaussians.gaussians import Gaussians, finite, joined
from ..gaussians.sh import COEFFICIENTS, MAX_DEGREE, rgb_to_sh0
from ..meshes.mesh import linear_to_srgb
from .packing import FLOAT_OPACITY_MARGIN, displayed, is_linear, logits, opacities, unit_quats
from .reading import reading, require

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
LAYER, ALIGNMENT, ZIP_HEADER = "gaussians.usda", 64, 30
"""Of a USDZ: the layer's name, the alignment of its content, the size of the header before it."""
PADDING, PADDING_ID = struct.Struct("<HH"), 0x1986
"""The extra field that aligns the content, and OpenUSD's mark of it."""
PRIMS = re.compile(rb"^[ \t]*(?:def|over|class|variantSet)\b.*", re.MULTILINE)
ATTRIBUTE = re.compile(
    rb"^[ \t]*(?:custom )?(?:uniform )?([\w\[\]]+) ([\w:]+) = (.*)", re.MULTILINE
)
METADATA = re.compile(rb" \(\n(?:.*\n)*?[ \t]*\)[ \t]*$", re.MULTILINE)
"""Of the prim, or of one of its attributes."""
NOTES = re.compile(rb'string\[\] notes = \[((?:"[^"\\]*"(?:, )?)*)\]')
WIDTHS = {"point3f[]": 3, "float3[]": 3, "color3f[]": 3, "quatf[]": 4, "float[]": 1}
"""Numbers of one value, by the type of an array."""
ARRAYS = tuple(name for name in TYPES if name != DEGREE)
DEFAULTS = {"orientations": [1.0, 0, 0, 0], "opacities": [1.0]}
"""Of all Gaussians, in files that leave an attribute out."""


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
    content begins at a multiple of 64 bytes; the rest is as for :func:`write_usda`.
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
    said = ", ".join(f'"{note}"' for note in notes)
    custom = f"    customLayerData = {{\n        string[] notes = [{said}]\n    }}\n"
    head = (
        f'{MAGIC}\n(\n{custom if notes else ""}    defaultPrim = "{PRIM}"\n'
        f'    metersPerUnit = 1\n    upAxis = "{USDA_UP.upper()}"\n)\n\n'
        f'def {SCHEMA} "{PRIM}"\n{{\n'
        f"    float3[] extent = [{', '.join(map(_tuple, _extent(gaussians)))}]\n"
        f"    uniform {TYPES[DEGREE]} {DEGREE} = {gaussians.sh_degree}\n"
    )
    file.write(head.encode("ascii"))
    harmonics = gaussians.sh.shape[1]
    arrays = {
        "positions": gaussians.means,
        "orientations": unit_quats(gaussians.quats).astype(np.float32),
        "scales": np.exp(gaussians.log_scales),
        "opacities": opacities(gaussians.logit_opacities).astype(np.float32),
        HARMONICS: gaussians.sh.reshape(len(gaussians.sh) * harmonics, 3),
    }
    for name, values in arrays.items():
        file.write(f"    {TYPES[name]} {name} = [".encode())
        for at in range(0, len(values), 4096):  # values that are formatted at once
            rows = map(_tuple, values[at : at + 4096])
            file.write((", " if at else "").encode() + ", ".join(rows).encode())
        layout = f'elementSize = {harmonics}\n        interpolation = "vertex"\n    )\n'
        file.write(f"] (\n        {layout}".encode() if name == HARMONICS else b"]\n")
    file.write(b"}\n")


def _tuple(value: np.ndarray) -> str:
    if value.ndim == 0:
        return f"{value:.9g}"
    return f"({', '.join(f'{number:.9g}' for number in value)})"


def _extent(gaussians: Gaussians) -> np.ndarray:
    """Return the corners of the box that holds the Gaussians to 3 standard deviations, (2, 3)."""
    if not len(gaussians.means):
        return np.zeros((2, 3), np.float32)
    reach = 3.0 * np.exp(gaussians.log_scales.max(axis=1, keepdims=True).astype(np.float64))
    corners = [(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)]
    return np.clip(np.stack(corners), -3e38, 3e38).astype(np.float32)


def read_usd(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read a USD file of any kind; see :func:`read_usda`, which needs no library.

    Raises:
        UserError: there is no such file, it holds no Gaussians that are supported, it is damaged,
            or only OpenUSD could read it and isn't installed.
    """
    try:
        return read_usda(path)
    except UserError as error:
        with reading(path, "USD file") as file:
            try:
                import pxr  # noqa: F401
            except ImportError:
                raise UserError(
                    f"{error}; OpenUSD reads more kinds of files: pip install usd-core (the extra "
                    "[usd]), or export it as .usda with one prim"
                ) from error
            try:
                return _read_by_openusd(file)
            except Exception as damage:  # OpenUSD's, with several lines about its own source
                reason = str(damage).strip().splitlines()[0].rpartition(" : ")[2]
                raise UserError(f"{error}; OpenUSD: {reason[:200]}") from damage


def read_usda(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read the Gaussians, y up, also those that aren't finite, and the notes of a USDA file, or of
    a USDZ that begins with one.

    Raises:
        UserError: there is no such file, it has another content or layout, or it is damaged.
    """
    with reading(path, "USD file") as file:
        text = _text(file)
        begins = text.startswith(MAGIC.encode())
        require(begins, f"this is not a USDA file, which begins with {MAGIC!r}")
        metadata, _, body = text.partition(f"def {SCHEMA}".encode())
        prims = [line.decode("ascii", "replace")[:60] for line in PRIMS.findall(text)]
        whole = text.rstrip().endswith(b"\n}") and len(prims) == 1 and body
        require(whole, f"expected one prim 'def {SCHEMA} \"name\"' and its '}}', got {prims[:3]}")
        axes = re.findall(rb'upAxis = "(\w+)"', metadata)
        require(set(axes) <= {b"Y", b"Z"}, f"only y or z up is read, and its upAxis is {axes}")
        linear = any(map(is_linear, re.findall(rb"\bcolorSpace(?::name)? = (.*)", body)))
        body = METADATA.sub(b"", body)
        changing = re.search(rb"\.(?:timeSamples|connect|spline)\b", body)
        require(not changing, "its values change with time or are those of others")
        entries = ATTRIBUTE.findall(body)
        found = {name.decode(): (kind.decode(), value.rstrip()) for kind, name, value in entries}
        require(len(entries) == len(found), "an attribute of the prim is given twice")
        require({"positions", "scales"} <= found.keys(), "the prim has no positions or no scales")
        moved = found.get("xformOpOrder", ("", b"[]"))[1] != b"[]"
        require(not moved, "the prim has a transform")
        for name, kind in TYPES.items():
            other = found.get(name, (kind,))[0]
            require(other == kind, f"{name} should be {kind}, not {other}")
        arrays = {name: _array(found.get(name, ("", b"[]"))[1], name) for name in ARRAYS}
        degree = found.get(DEGREE, ("", b"3"))[1].decode("ascii", "replace")
        gaussians = _built(degree, arrays, linear, str(file))
        if axes[:1] == [b"Z"]:
            gaussians = rotate(gaussians, rotation_between("z", USDA_UP))
        said = NOTES.search(metadata)
        notes = re.findall(rb'"([^"]*)"', said[1]) if said else []
        return gaussians, [note.decode("ascii", "replace") for note in notes]


def _text(path: Path) -> bytes:
    """Return a layer, in a USDZ its first file, without comments and texts of several lines."""
    data = path.read_bytes()
    if data[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            first = archive.infolist()[0]
            stored = first.compress_type == zipfile.ZIP_STORED  # or it may be larger than the file
            require(stored, "it is a compressed zip archive, which no USDZ may be")
            data = archive.read(first)
    for quotes in (b'"""', b"'''"):
        parts = data.split(quotes)
        require(len(parts) % 2 == 1, "it has a text without an end: it is truncated")
        data = b'""'.join(parts[::2])
    magic, _, rest = data.partition(b"\n")
    return magic + b"\n" + re.sub(rb"(?m)^[ \t]*#.*", b"", rest)


def _read_by_openusd(path: Path) -> tuple[Gaussians, list[str]]:
    """Read all prims of a stage."""
    from pxr import Usd, UsdGeom

    stage, now = Usd.Stage.Open(str(path)), Usd.TimeCode.EarliestTime()
    worlds = UsdGeom.XformCache(now)
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    name = f"USD file {str(path)!r}"
    parts = [
        placed(_of_prim(prim, now, path), np.array(worlds.GetLocalToWorldTransform(prim)).T, name)
        for prim in prims
        if prim.GetTypeName() == SCHEMA
    ]
    require(bool(parts), f"none of its prims is a {SCHEMA}")
    notes, gaussians = stage.GetRootLayer().customLayerData.get("notes", []), joined(parts)
    if (up := UsdGeom.GetStageUpAxis(stage).lower()) != USDA_UP:
        gaussians = rotate(gaussians, rotation_between(up, USDA_UP))
    return gaussians, [str(note) for note in notes]


def _of_prim(prim: Any, now: Any, path: Path) -> Gaussians:
    """Read one prim, whose attributes of half precision have names that end with h."""

    def array(name: str) -> np.ndarray:
        found = [prim.GetAttribute(name + ending).Get(now) for ending in ("", "h")
                 if prim.HasAttribute(name + ending)]  # fmt: skip
        values = next((value for value in found if value), ())
        rows = np.array(values, np.float32).reshape(-1, WIDTHS[TYPES[name]])
        return rows[:, [3, 0, 1, 2]] if name == "orientations" else rows  # OpenUSD's are xyzw

    harmonics, space = prim.GetAttribute(HARMONICS), prim.GetAttribute("colorSpace:name")
    spaces = [space.Get() if space else "", harmonics.GetColorSpace() if harmonics else ""]
    degree, arrays = prim.GetAttribute(DEGREE).Get(), {name: array(name) for name in ARRAYS}
    return _built(str(degree), arrays, any(map(is_linear, spaces)), str(path))


def _built(
    degree: str, arrays: dict[str, Float[np.ndarray, "N width"]], linear: bool, name: str
) -> Gaussians:
    """Check a prim's values and return its Gaussians; ``name`` is for the message."""
    count, colors = len(arrays["positions"]), arrays.pop(COLORS)
    for attribute, value in DEFAULTS.items():
        if not len(arrays[attribute]):
            arrays[attribute] = np.tile(np.float32(value), (count, 1))
    if count and not len(arrays[HARMONICS]):
        colors = linear_to_srgb(colors) if len(colors) in (1, count) else np.full((1, 3), 0.5)
        degree, sh = "0", rgb_to_sh0(colors).astype(np.float32)
        arrays[HARMONICS] = np.broadcast_to(sh, (count, 3))
    usual = degree in map(str, range(MAX_DEGREE + 1))
    require(usual, f"{DEGREE} should be 0 to {MAX_DEGREE}, not {degree[:60]!r}")
    harmonics = COEFFICIENTS[int(degree)]
    for attribute, values in arrays.items():
        expected = count * (harmonics if attribute == HARMONICS else 1)
        said = f"{attribute} has {len(values)} values, expected {expected}"
        require(len(values) == expected, said)
    gaussians = Gaussians(
        means=arrays["positions"],
        quats=arrays["orientations"],
        log_scales=np.log(arrays["scales"]),
        logit_opacities=logits(arrays["opacities"][:, 0], FLOAT_OPACITY_MARGIN),
        sh=arrays[HARMONICS].reshape(count, harmonics, 3),
    )
    return displayed(gaussians, name) if linear else gaussians


def _array(text: bytes, name: str) -> Float[np.ndarray, "N width"]:
    """Parse an array of tuples, or of numbers as tuples of one, as float32."""
    width = WIDTHS[TYPES[name]]
    bracketed = text.startswith(b"[") and text.endswith(b"]")
    require(bracketed, f"{name} should be an array in brackets on one line")
    text = text[1:-1]
    if not text.strip():
        return np.empty((0, width), np.float32)
    marks = text.translate(None, b"0123456789+-.eEinfa ")  # also inf and nan
    one = b"(" + b"," * (width - 1) + b")" if width > 1 else b""
    count = marks.count(b"(") if width > 1 else marks.count(b",") + 1
    usual = marks == b",".join([one] * count)
    require(usual, f"{name} should consist of {f'tuples of {width} ' * (width > 1)}numbers")
    parts = text.translate(bytes.maketrans(b"()", b"  ")).split(b",")
    numbers = np.fromiter(map(float, parts), np.float64, len(parts))
    return numbers.astype(np.float32).reshape(count, width)
