"""Damage valid files at random, from a seed; half of the packed ones (zip, gzip, GLB) inside."""

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Optional

import numpy as np
import zstandard

from tests.helpers.gltf_builder import glb_bytes

NUMBERS = (
    b"0 -0 1 -1 2 3 255 256 65535 65536 -2147483648 2147483647 4294967295 9223372036854775807 "
    b"99999999999999999999 1e400 -1e400 1e38 3.5e38 1e-45 1e-400 nan inf -inf 0x10 1_000 0.1.2 "
    b"1e 1,5 007 +5 --1 1000000000 1000000000000"
).split()
TOKENS = [
    b"", b"\0", b" ", b"\n", b"\r\n", b"\t", b"\x1a", b"\xff\xfe", b"\xef\xbb\xbf", b"\xc3\x28",
    b"\xf0\x9f\xa6\x8a", b"\\", b'"', b"'", b"%s%n", b"../" * 8, b"null", b"true", b"[]", b"{}",
    b"[" * 50, b"(" * 50, b"#", b"${", b"???", b"-", b"=", b":", b"A" * 300,
]  # fmt: skip
EXTREMES = [0, 1, 2, 3, 127, 32767, *(2**n - k for n in (8, 16, 31, 32, 64) for k in (0, 1)), 2**24]
FLOATS = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e38, -3.4e38, 1e-45, 1e-38, 1.0, -1.0, 255.0, 0.5]
LARGEST = 1 << 16
"""Bytes by which a mutant may grow."""

Rng = np.random.Generator
Mutator = Callable[[bytes, Rng], bytes]


def _choice(values: list, rng: Rng) -> Any:
    return values[rng.integers(len(values))]


def _range(data: bytes, rng: Rng) -> tuple[int, int]:
    """Draw a range of bytes, usually a short one."""
    start = int(rng.integers(0, len(data)))
    return start, min(start + int(2 ** rng.uniform(0, 10)), len(data))


def flip_bits(data: bytes, rng: Rng) -> bytes:
    damaged = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        damaged[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def truncate(data: bytes, rng: Rng) -> bytes:
    return data[: rng.integers(len(data))]


def repeat_block(data: bytes, rng: Rng) -> bytes:
    """Remove a block, or repeat it once or up to a thousand times."""
    start, end = _range(data, rng)
    many = min(1000, LARGEST // max(end - start, 1))
    return data[:start] + data[start:end] * int(rng.choice([0, 0, 2, 2, many])) + data[end:]


def swap_blocks(data: bytes, rng: Rng) -> bytes:
    a, b, c, d = sorted(rng.integers(0, len(data) + 1, 4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def overwrite_block(data: bytes, rng: Rng) -> bytes:
    """Overwrite with zeros, ones, noise, or another part of the file."""
    start, end = _range(data, rng)
    size, source = end - start, int(rng.integers(0, len(data)))
    fills = [bytes(size), b"\xff" * size, rng.bytes(size), data[source : source + size]]
    return data[:start] + _choice(fills, rng) + data[end:]


def extreme_number(data: bytes, rng: Rng) -> bytes:
    """Write an extreme binary integer of 1 to 8 bytes, or an extreme float."""
    kind, order = str(rng.choice([*"BHIQfd", *"BHIQ"])), str(rng.choice([*"<<>"]))
    if kind in "fd":
        number = np.array(_choice(FLOATS, rng)).astype(order + kind).tobytes()
    else:
        bits = 8 * struct.calcsize(kind)
        number = struct.pack(order + kind, _choice(EXTREMES, rng) & (1 << bits) - 1)
    start = int(rng.integers(0, len(data)))
    return data[:start] + number + data[start + len(number) :]


def insert_token(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(0, len(data) + 1))
    return data[:at] + _choice(TOKENS, rng) + data[at:]


WORD = re.compile(rb"[^\s\[\]{}(),:=\"']+")
NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def _replaced(pattern: re.Pattern, data: bytes, rng: Rng, new: bytes) -> bytes:
    """Replace one match near a random position."""
    match = pattern.search(data, int(rng.integers(0, len(data)))) or pattern.search(data)
    return data if match is None else data[: match.start()] + new + data[match.end() :]


def other_number(data: bytes, rng: Rng) -> bytes:
    """Replace a number in the text by an extreme one, such as a wrong count."""
    return _replaced(NUMBER, data, rng, _choice(NUMBERS, rng))


def other_word(data: bytes, rng: Rng) -> bytes:
    """Replace a word by another word of the file or by a special token."""
    words = WORD.findall(data[:4096]) or [b"x"]
    return _replaced(WORD, data, rng, _choice(words if rng.random() < 0.7 else TOKENS, rng))


def line_operation(data: bytes, rng: Rng) -> bytes:
    """Repeat, drop or exchange a line."""
    lines = data.split(b"\n")
    i, j = (int(x) for x in rng.integers(0, len(lines), 2))
    action = rng.integers(3)
    if action == 0:
        lines.insert(j, lines[i])
    elif action == 1:
        del lines[i]
    else:
        lines[i], lines[j] = lines[j], lines[i]
    return b"\n".join(lines)


def json_value(data: bytes, rng: Rng) -> bytes:
    """Replace one value of a JSON document by one of another type or size, or remove it."""
    try:
        document = json.loads(data)
        places = list(_places(document))
    except (ValueError, RecursionError):
        return other_word(data, rng)
    if not places:
        return data
    holder, key = _choice(places, rng)
    values = [
        None, True, -1, 0, 1, 5, 2**31, 10**12, 1e300, "x", "", [], {}, [0], [1e38] * 16, {"a": 1},
        5121, 5123, 5125, 5126, "VEC3",
    ]  # fmt: skip
    others = [container[name] for container, name in places]
    value = _choice(values if rng.random() < 0.6 else others, rng)
    if rng.random() < 0.1 and isinstance(holder, dict):
        del holder[key]
    else:
        holder[key] = value
    try:
        return json.dumps(document).encode()
    except (ValueError, RecursionError):  # the document contains itself
        return data


def _places(document: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every (container, key) of a JSON document."""
    if isinstance(document, (dict, list)):
        for key in document if isinstance(document, dict) else range(len(document)):
            yield document, key
            yield from _places(document[key])


BINARY: list[Mutator] = [
    flip_bits, truncate, repeat_block, swap_blocks, overwrite_block, extreme_number, insert_token
]  # fmt: skip
TEXT: list[Mutator] = [
    other_number, other_number, other_word, line_operation, flip_bits, repeat_block, insert_token,
    truncate,
]  # fmt: skip


class Packing(NamedTuple):
    """Functions that split a file into named pieces and join them again."""

    unpack: Callable[[bytes], list[tuple[str, bytes]]]
    pack: Callable[[list[tuple[str, bytes]]], bytes]
    text: tuple[str, ...] = ()
    """Names of the pieces that are text."""


def _unzip(data: bytes) -> list[tuple[str, bytes]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [(name, archive.read(name)) for name in archive.namelist()]


def _zip(pieces: list[tuple[str, bytes]]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in pieces:
            archive.writestr(zipfile.ZipInfo(name), content)
    return buffer.getvalue()


def _unglb(data: bytes) -> list[tuple[str, bytes]]:
    """The chunks: "JSON" and "BIN"."""
    pieces, at = [], 12
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        pieces.append((kind.rstrip(b"\0").decode("latin-1"), data[at + 8 : at + 8 + size]))
        at += 8 + size
    return pieces


def _unply(data: bytes) -> list[tuple[str, bytes]]:
    head, end, body = data.partition(b"end_header\n")
    return [("header", head + end), ("body", body)]


ZIP = Packing(_unzip, _zip)
GZIP = Packing(
    lambda data: [("data", zlib.decompress(data, 16 + zlib.MAX_WBITS))],
    lambda pieces: gzip.compress(pieces[0][1], mtime=0),
)
GLB = Packing(_unglb, glb_bytes, text=("JSON",))
PLY = Packing(_unply, lambda pieces: b"".join(part for _, part in pieces), text=("header",))
UNPACKABLE = ValueError, IndexError, OSError, zipfile.BadZipFile, zlib.error, struct.error
UNPACKABLE += (zstandard.ZstdError,)


def damaged(data: bytes, rng: Rng, mutators: list[Mutator]) -> bytes:
    """Apply one to four kinds of damage."""
    for _ in range(1 if rng.random() < 0.5 else int(rng.integers(2, 5))):
        if data:
            data = _choice(mutators, rng)(data, rng)[: len(data) + LARGEST]
    return data


def mutant(seeds: list[bytes], rng: Rng, mutators: list[Mutator], packing: Optional[Packing]):
    """Return a damaged copy of one of ``seeds``, or a splice of two."""
    data = _choice(seeds, rng)
    if rng.random() < 0.05:
        other = _choice(seeds, rng)
        data = data[: rng.integers(len(data) + 1)] + other[rng.integers(len(other) + 1) :]
    if packing is None or rng.random() < 0.5:
        return damaged(data, rng, mutators)
    try:
        pieces = packing.unpack(data)
    except UNPACKABLE:  # a splice
        return damaged(data, rng, mutators)
    at = int(rng.integers(len(pieces)))
    name, content = pieces[at]
    own = TEXT if name in packing.text else mutators
    own = [*TEXT, *[json_value] * 8] if name in ("JSON", "meta.json") else own
    pieces[at] = (name, damaged(content, rng, own))
    return packing.pack(pieces)
