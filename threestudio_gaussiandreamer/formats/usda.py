"""USDA text of one ParticleField3DGaussianSplat prim, the Gaussians of OpenUSD from 26.03 on, for
Omniverse, Houdini and other programs of film and simulation. Writing needs no USD library.

Scales and opacities are linear, quaternions (w, x, y, z), coefficients of a Gaussian one after the
other, all float32 with 9 digits. Axes: y up, front +z; one unit is one metre. USD has no attribute
for antialiasing: it and the notes are in the layer's ``customLayerData``.

Text of one such prim at the top of its layer, with one line for each attribute, as this module,
OpenUSD and NVIDIA's converter write it, is read here, also inside a USDZ; all else by OpenUSD where
it is installed: binary layers, scenes with transforms, references and several prims, half
precision, and the first of time samples. Other attributes are ignored, and so is the unit of the
layer."""

import io
import os
import re
import struct
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError
from ..core.files import atomic_file, existing_file
from ..gaussians.axes import placed, rotate, rotation_between
from ..gaussians.gaussians import Gaussians, finite, joined
from ..gaussians.sh import COEFFICIENTS, MAX_DEGREE, rgb_to_sh0
from ..meshes.mesh import linear_to_srgb
from .packing import FLOAT_OPACITY_MARGIN, displayed, is_linear, logits, opacities, unit_quats

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
PRIM_LINE = re.compile(rb'def %b "\w+"( \()?' % SCHEMA.encode())
HEAD = re.compile(rb"(?:custom )?(?:uniform )?([\w\[\]]+) ([\w:]+)")
LONG_QUOTES = (b'"""', b"'''")
"""Marks at both ends of texts of several lines."""
COLOR_SPACE = "colorSpace:name"
"""The attribute by which a prim names the colour space of its harmonics."""
COLOR_SPACE_OF_ARRAY = re.compile(rb"^colorSpace = (.*)", re.MULTILINE)
TRANSFORM = "xformOpOrder"
UP_AXIS = re.compile(rb'upAxis = "(\w+)"')
NOTES = re.compile(rb'string\[\] notes = \[((?:"[^"\\]*"(?:, )?)*)\]')
WIDTHS = {"point3f[]": 3, "float3[]": 3, "color3f[]": 3, "quatf[]": 4, "float[]": 1}
"""Numbers of one value, by the type of an array."""
ARRAYS = tuple(name for name in TYPES if name != DEGREE)
DEFAULTS = {"orientations": [1.0, 0, 0, 0], "opacities": [1.0]}
"""Of all Gaussians, in files that leave an attribute out."""
OF_NUMBERS = b"0123456789+-.eEinfa "
"""Bytes that numbers consist of, inf and nan included."""
TO_SPACES = bytes.maketrans(b"()", b"  ")


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


# ---- reading -------------------------------------------------------------------------------------


def read_usd(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read a USD file of any kind; see :func:`read_usda`, which needs no library.

    Raises:
        UserError: there is no such file, it holds no Gaussians that are supported, it is damaged,
            or only OpenUSD could read it and isn't installed.
    """
    try:
        return read_usda(path)
    except UserError as error:
        path = existing_file(path, "USD file")
        try:
            from pxr import Tf
        except ImportError:
            raise UserError(
                f"{error}; OpenUSD reads more kinds of files: pip install usd-core (the extra "
                "[usd]), or export it as .usda with one prim"
            ) from error
        try:
            return _read_by_openusd(path)
        except Tf.ErrorException as damage:
            reason = str(damage).strip().splitlines()[0].rpartition(" : ")[2]
            raise UserError(f"{error}; OpenUSD: {reason[:200]}") from damage


def read_usda(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read a USDA file, or a USDZ that begins with one; rows with values that aren't finite are
    kept.

    Returns:
        the Gaussians, y up, and the notes in the layer's custom data.

    Raises:
        UserError: there is no such file, it has another content or layout, or it is damaged.
    """
    path = existing_file(path, "USD file")
    try:
        lines = _Lines(_text(path), path)
    except OSError as error:
        raise UserError(f"cannot read {str(path)!r}: {error.strerror or error}.") from error
    up, notes = _read_head(lines)
    return _upright(_gaussians(_read_attributes(lines), lines), up), notes


def _text(path: Path) -> bytes:
    """Return the content of a layer, in a USDZ that of its first file."""
    data = path.read_bytes()
    if data[:2] != b"PK":
        return data
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            first = archive.infolist()[0]
            if first.compress_type != zipfile.ZIP_STORED:  # or it may be larger than the file
                raise UserError(
                    f"USDZ file {str(path)!r} is a compressed zip archive, which no USDZ may be: "
                    "write it by a program that exports USDZ"
                )
            return archive.read(first)
    except UserError:
        raise
    except (zipfile.BadZipFile, IndexError, ValueError, EOFError, RuntimeError) as error:
        raise UserError(f"USDZ file {str(path)!r} is damaged: {error}") from error


def _upright(gaussians: Gaussians, up: str) -> Gaussians:
    """Return Gaussians of a layer with y up."""
    return gaussians if up == USDA_UP else rotate(gaussians, rotation_between(up, USDA_UP))


# ---- OpenUSD -------------------------------------------------------------------------------------


def _read_by_openusd(path: Path) -> tuple[Gaussians, list[str]]:
    """Read all prims of a stage."""
    from pxr import Usd, UsdGeom

    stage, now = Usd.Stage.Open(str(path)), Usd.TimeCode.EarliestTime()
    worlds = UsdGeom.XformCache(now)
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    parts = [
        placed(
            _of_prim(prim, now, path),
            np.array(worlds.GetLocalToWorldTransform(prim)).T,
            f"USD file {str(path)!r}",
        )
        for prim in prims
        if prim.GetTypeName() == SCHEMA
    ]
    if not parts:
        raise UserError(f"USD file {str(path)!r}: none of its prims is a {SCHEMA}")
    notes = stage.GetRootLayer().customLayerData.get("notes", [])
    up = UsdGeom.GetStageUpAxis(stage).lower()
    return _upright(joined(parts), up), [str(note) for note in notes]


def _of_prim(prim: Any, now: Any, path: Path) -> Gaussians:
    """Read one prim, whose attributes of half precision have names that end with h."""

    def fail(problem: str) -> NoReturn:
        raise UserError(f"USD file {str(path)!r}, prim {prim.GetPath()}: {problem}")

    def array(name: str) -> np.ndarray:
        found = [prim.GetAttribute(name + ending).Get(now) for ending in ("", "h")
                 if prim.HasAttribute(name + ending)]  # fmt: skip
        values = next((value for value in found if value), ())
        rows = np.array(values, np.float32).reshape(-1, WIDTHS[TYPES[name]])
        return rows[:, [3, 0, 1, 2]] if name == "orientations" else rows  # OpenUSD's are xyzw

    harmonics, space = prim.GetAttribute(HARMONICS), prim.GetAttribute(COLOR_SPACE)
    spaces = [space.Get() if space else "", harmonics.GetColorSpace() if harmonics else ""]
    degree, arrays = prim.GetAttribute(DEGREE).Get(), {name: array(name) for name in ARRAYS}
    return _built(str(degree), arrays, any(map(is_linear, spaces)), str(path), fail)


# ---- layout --------------------------------------------------------------------------------------


class _Attribute(NamedTuple):
    type: bytes
    value: bytes


EMPTY, USUAL_DEGREE = _Attribute(b"token[]", b"[]"), _Attribute(b"int", b"3")


class _Lines:
    """The lines of a layer, stripped, without empty ones, comments and the content of texts of
    several lines.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        for quotes in LONG_QUOTES:
            parts = data.split(quotes)
            parts[1::2] = [b'""' + b"\n" * text.count(b"\n") for text in parts[1::2]]
            data = b"".join(parts)
        self._lines, self.path, self.number = data.split(b"\n"), path, 0

    def take(self) -> bytes:
        """Return the next line, or an empty one at the end."""
        while self.number < len(self._lines):
            line = self._lines[self.number].strip()
            self.number += 1
            if line and (not line.startswith(b"#") or self.number == 1):
                return line
        return b""

    def take_until(self, end: bytes) -> list[bytes]:
        """Return the lines up to the one that is ``end``."""
        taken = []
        while (line := self.take()) != end:
            if not line:
                self.fail(f"it ends before the {end.decode()!r} of this block")
            taken.append(line)
        return taken

    def fail(self, problem: str) -> NoReturn:
        raise UserError(f"USDA file {str(self.path)!r}, line {self.number}: {problem}")


def _read_head(lines: _Lines) -> tuple[str, list[str]]:
    """Read up to the prim's opening brace; return the axis that is up, and the notes."""
    if lines.take() != MAGIC.encode():
        lines.fail(f"this is not a USDA file, which begins with {MAGIC!r}")
    line, metadata = lines.take(), b""
    if line == b"(":
        metadata = b"\n".join(_metadata(lines))
        line = lines.take()
    prim = PRIM_LINE.fullmatch(line)
    if prim is None:
        lines.fail(f"expected one prim 'def {SCHEMA} \"name\"', got {_shown(line)}")
    if prim[1]:
        _metadata(lines)
    if lines.take() != b"{":
        lines.fail("expected the '{' of the prim")
    return _up(metadata, lines), _notes(metadata)


def _up(metadata: bytes, lines: _Lines) -> str:
    axes = UP_AXIS.findall(metadata)
    if set(axes) - {b"Y", b"Z"}:
        lines.fail(f"only files with y or z up are read, and its upAxis is {_shown(axes[0])}")
    return axes[0].decode().lower() if axes else USDA_UP


def _notes(metadata: bytes) -> list[str]:
    """Return the notes in a layer's metadata."""
    found = NOTES.search(metadata)
    notes = re.findall(rb'"([^"]*)"', found[1]) if found else []
    return [note.decode("ascii", "replace") for note in notes]


def _read_attributes(lines: _Lines) -> dict[str, _Attribute]:
    """Return the attributes with values, by name; the prim has to be the last one."""
    found: dict[str, _Attribute] = {}
    while (line := lines.take()) != b"}":
        declared, _, value = line.partition(b" = ")
        head = HEAD.fullmatch(declared)
        if head is None:
            lines.fail(f"expected an attribute on one line or the prim's '}}', got {_shown(line)}")
        name = head[2].decode()
        if value and name in found:
            lines.fail(f"{name} is given twice")
        if value:
            found[name] = _Attribute(head[1], value.removesuffix(b" ("))
        if line.endswith(b" ("):
            metadata = b"\n".join(_metadata(lines))
            if name == HARMONICS and (space := COLOR_SPACE_OF_ARRAY.search(metadata)):
                found[COLOR_SPACE] = _Attribute(b"token", space[1])
    if found.get(TRANSFORM, EMPTY).value != EMPTY.value:
        lines.fail("the prim has a transform")
    if rest := lines.take():
        lines.fail(f"expected one prim, but after it there is {_shown(rest)}")
    return found


def _metadata(lines: _Lines) -> list[bytes]:
    """Return the lines up to the closing parenthesis, none of which may be an attribute."""
    taken = lines.take_until(b")")
    for line in taken:
        head = HEAD.fullmatch(line.partition(b" = ")[0])
        if head and head[2].decode() in TYPES:
            lines.fail(f"the metadata before has {_shown(line)}, an attribute of the prim")
    return taken


def _shown(line: bytes) -> str:
    return repr(line[:60].decode("ascii", "replace")) if line else "the end of the file"


# ---- values --------------------------------------------------------------------------------------


def _gaussians(attributes: dict[str, _Attribute], lines: _Lines) -> Gaussians:
    degree = attributes.get(DEGREE, USUAL_DEGREE).value.decode("ascii", "replace")
    arrays = {name: _array(attributes, name, lines) for name in ARRAYS}
    linear = is_linear(attributes.get(COLOR_SPACE, EMPTY).value)
    return _built(degree, arrays, linear, str(lines.path), lines.fail)


def _built(
    degree: str,
    arrays: dict[str, Float[np.ndarray, "N width"]],
    linear: bool,
    name: str,
    fail: Callable[[str], NoReturn],
) -> Gaussians:
    """Return the Gaussians of a prim after checking the numbers of its values.

    Args:
        linear: whether its colours are of linear light.
        name: the file, for messages.
    """
    count, colors = len(arrays["positions"]), arrays.pop(COLORS)
    for attribute, value in DEFAULTS.items():
        if not len(arrays[attribute]):
            arrays[attribute] = np.tile(np.float32(value), (count, 1))
    if count and not len(arrays[HARMONICS]):
        colors = linear_to_srgb(colors) if len(colors) in (1, count) else np.full((1, 3), 0.5)
        degree, sh = "0", rgb_to_sh0(colors).astype(np.float32)
        arrays[HARMONICS] = np.broadcast_to(sh, (count, 3))
    if degree not in map(str, range(MAX_DEGREE + 1)):
        fail(f"{DEGREE} should be 0 to {MAX_DEGREE}, not {degree[:60]!r}")
    harmonics = COEFFICIENTS[int(degree)]
    for attribute, values in arrays.items():
        expected = count * (harmonics if attribute == HARMONICS else 1)
        if len(values) != expected:
            fail(f"{attribute} has {len(values)} values, expected {expected}")
    with np.errstate(divide="ignore", invalid="ignore"):  # of scales that are 0 or negative
        log_scales = np.log(arrays["scales"])
    gaussians = Gaussians(
        means=arrays["positions"],
        quats=arrays["orientations"],
        log_scales=log_scales,
        logit_opacities=logits(arrays["opacities"][:, 0], FLOAT_OPACITY_MARGIN),
        sh=arrays[HARMONICS].reshape(count, harmonics, 3),
    )
    return displayed(gaussians, name) if linear else gaussians


def _value(attributes: dict[str, _Attribute], name: str, lines: _Lines) -> bytes:
    """Return the text of an attribute's value after checking its type."""
    expected = TYPES[name]
    if name not in attributes:
        lines.fail(f"the prim has no {expected} {name}")
    declared = attributes[name].type.decode("ascii", "replace")
    if declared != expected:
        lines.fail(f"{name} should be {expected}, not {declared}")
    return attributes[name].value


def _array(
    attributes: dict[str, _Attribute], name: str, lines: _Lines
) -> Float[np.ndarray, "N width"]:
    """Parse an array of tuples, or of numbers as tuples of one, as float32; empty if missing."""
    width = WIDTHS[TYPES[name]]
    if name in (*DEFAULTS, HARMONICS, COLORS) and name not in attributes:
        return np.empty((0, width), np.float32)
    text = _value(attributes, name, lines)
    if not (text.startswith(b"[") and text.endswith(b"]")):
        lines.fail(f"{name} should be an array in brackets on one line")
    text = text[1:-1]
    if not text.strip():
        return np.empty((0, width), np.float32)
    marks = text.translate(None, OF_NUMBERS)
    one = b"(" + b"," * (width - 1) + b")" if width > 1 else b""
    count = marks.count(b"(") if width > 1 else marks.count(b",") + 1
    if marks != b",".join([one] * count):
        lines.fail(f"{name} should consist of {f'tuples of {width} ' * (width > 1)}numbers")
    parts = text.translate(TO_SPACES).split(b",")
    try:
        numbers = np.fromiter(map(float, parts), np.float64, len(parts))
    except ValueError as error:
        lines.fail(f"{name}: {error}"[:200])
    with np.errstate(over="ignore", invalid="ignore"):
        return numbers.astype(np.float32).reshape(count, width)
