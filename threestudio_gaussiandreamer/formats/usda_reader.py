"""Read USDA text of one ParticleField3DGaussianSplat prim at the top of its layer, with one line
for each attribute, as ``usda.py`` and OpenUSD write it.

Other prims, transforms, references, time samples and half precision aren't read; other attributes
are ignored. The unit of the layer is ignored too."""

import os
import re
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError
from ..core.files import existing_file
from ..gaussians.gaussians import Gaussians
from ..gaussians.sh import COEFFICIENTS, MAX_DEGREE
from .packing import FLOAT_OPACITY_MARGIN, logits
from .usda import DEGREE, HARMONICS, MAGIC, SCHEMA, TYPES

PRIM = re.compile(rb'def %b "\w+"( \()?' % SCHEMA.encode())
HEAD = re.compile(rb"(?:custom )?(?:uniform )?([\w\[\]]+) ([\w:]+)")
UP_AXIS = re.compile(rb'upAxis = "(\w+)"')
NOTES = re.compile(rb'string\[\] notes = \[((?:"[^"\\]*"(?:, )?)*)\]')
WIDTHS = {"point3f[]": 3, "float3[]": 3, "quatf[]": 4, "float[]": 1}
"""Numbers of one value, by the type of an array."""
OF_NUMBERS = b"0123456789+-.eEinfa "
"""Bytes that numbers consist of, inf and nan included."""
TO_SPACES = bytes.maketrans(b"()", b"  ")


def read_usda(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read a USDA file; rows with values that aren't finite are kept.

    Returns:
        the Gaussians, y up, and the notes in the layer's custom data.

    Raises:
        UserError: there is no such file, it has another content or layout, or it is damaged.
    """
    path = existing_file(path, "USDA file")
    try:
        lines = _Lines(path.read_bytes(), path)
    except OSError as error:
        raise UserError(f"cannot read {str(path)!r}: {error.strerror or error}.") from error
    notes = _read_head(lines)
    return _gaussians(_read_attributes(lines), lines), notes


# ---- layout --------------------------------------------------------------------------------------


class _Attribute(NamedTuple):
    type: bytes
    value: bytes


class _Lines:
    """The lines of a layer, stripped, without empty ones and comments."""

    def __init__(self, data: bytes, path: Path) -> None:
        self._lines, self._path, self.number = data.split(b"\n"), path, 0

    def take(self) -> bytes:
        """Return the next line, or an empty one at the end."""
        while self.number < len(self._lines):
            line = self._lines[self.number].strip()
            self.number += 1
            if b'"""' in line:
                self.fail("texts of several lines aren't read")
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
        raise UserError(f"USDA file {str(self._path)!r}, line {self.number}: {problem}")


def _read_head(lines: _Lines) -> list[str]:
    """Read up to the prim's opening brace; return the notes."""
    if lines.take() != MAGIC.encode():
        lines.fail(f"this is not a USDA file, which begins with {MAGIC!r}")
    line, notes = lines.take(), []
    if line == b"(":
        notes = _notes(_metadata(lines), lines)
        line = lines.take()
    prim = PRIM.fullmatch(line)
    if prim is None:
        lines.fail(f"expected one prim 'def {SCHEMA} \"name\"', got {_shown(line)}")
    if prim[1]:
        _metadata(lines)
    if lines.take() != b"{":
        lines.fail("expected the '{' of the prim")
    return notes


def _notes(metadata: list[bytes], lines: _Lines) -> list[str]:
    """Return the notes in a layer's metadata, after checking that y is up."""
    text = b"\n".join(metadata)
    axes = UP_AXIS.findall(text)
    if set(axes) - {b"Y"}:
        lines.fail(f"only files with y up are read, and its upAxis is {_shown(axes[0])}")
    found = NOTES.search(text)
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
            _metadata(lines)
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
    degree = _value(attributes, DEGREE, lines)
    if degree not in [b"%d" % known for known in range(MAX_DEGREE + 1)]:
        lines.fail(f"{DEGREE} should be 0 to {MAX_DEGREE}, not {_shown(degree)}")
    arrays = {name: _array(attributes, name, lines) for name in TYPES if name != DEGREE}
    count, harmonics = len(arrays["positions"]), COEFFICIENTS[int(degree)]
    for name, values in arrays.items():
        expected = count * (harmonics if name == HARMONICS else 1)
        if len(values) != expected:
            lines.fail(f"{name} has {len(values)} values, expected {expected}")
    with np.errstate(divide="ignore", invalid="ignore"):  # of scales that are 0 or negative
        log_scales = np.log(arrays["scales"])
    return Gaussians(
        means=arrays["positions"],
        quats=arrays["orientations"],
        log_scales=log_scales,
        logit_opacities=logits(arrays["opacities"][:, 0], FLOAT_OPACITY_MARGIN),
        sh=arrays[HARMONICS].reshape(count, harmonics, 3),
    )


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
    """Parse an array of tuples, or of numbers as tuples of one, as float32."""
    text, width = _value(attributes, name, lines), WIDTHS[TYPES[name]]
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
