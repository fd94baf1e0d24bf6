"""Damage valid files at random, from a seed; half of the packed ones (zip, gzip, GLB) inside."""

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

NUMBERS = (
    b"0 -0 1 -1 2 3 255 256 65535 65536 -2147483648 2147483647 4294967295 "
    b"9223372036854775807 99999999999999999999 1e400 -1e400"
).split()
NUMBERS += (
    b"1e38 3.5e38 1e-45 1e-400 nan inf -inf 0x10 1_000 0.1.2 1e 1,5 007 +5 --1 "
    b"1000000000 1000000000000"
).split()
TOKENS = [
    b"",
    b"\0",
    b" ",
    b"\n",
    b"\r\n",
    b"\t",
    b"\x1a",
    b"\xff\xfe",
    b"\xef\xbb\xbf",
    b"\xc3\x28",
    b"\xf0\x9f\xa6\x8a",
    b"\\",
    b'"',
    b"'",
]
TOKENS += [
    b"%s%n",
    b"../" * 8,
    b"null",
    b"true",
    b"[]",
    b"{}",
    b"[" * 50,
    b"(" * 50,
    b"#",
    b"${",
    b"???",
    b"-",
    b"=",
    b":",
    b"A" * 300,
]
EXTREMES = [
    0,
    1,
    2,
    3,
    127,
    128,
    255,
    256,
    32767,
    65535,
    65536,
    2**24,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63 - 1,
    2**64 - 1,
]
FLOATS = [
    float("nan"),
    float("inf"),
    -float("inf"),
    0.0,
    -0.0,
    1e38,
    -3.4e38,
    1e-45,
    1e-38,
    1e300,
    1.0,
    -1.0,
    255.0,
    0.5,
]
MOST_OPERATIONS = 4
LARGEST = 1 << 16
"""Bytes of the largest mutant; blocks are repeated no further."""

Mutator = Callable[[bytes, np.random.Generator], bytes]


def _choice(values: list, rng: np.random.Generator) -> Any:
    return values[rng.integers(len(values))]


# ---- damage to bytes -----------------------------------------------------------------------------


def flip_bits(data: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        damaged[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(len(data))]


def delete_block(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _range(data, rng)
    return data[:start] + data[end:]


def duplicate_block(data: bytes, rng: np.random.Generator) -> bytes:
    """Repeat a block once or up to a thousand times."""
    start, end = _range(data, rng)
    times = 1 if rng.random() < 0.7 else min(1000, LARGEST // max(end - start, 1))
    return data[:end] + data[start:end] * times + data[end:]


def swap_blocks(data: bytes, rng: np.random.Generator) -> bytes:
    a, b, c, d = sorted(rng.integers(0, len(data) + 1, 4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def overwrite_block(data: bytes, rng: np.random.Generator) -> bytes:
    """Overwrite with zeros, ones, noise, or another part of the file."""
    start, end = _range(data, rng)
    size, source = end - start, int(rng.integers(0, len(data)))
    fill = [bytes(size), b"\xff" * size, rng.bytes(size), data[source : source + size]][
        int(rng.integers(4))
    ]
    return data[:start] + fill + data[end:]


def extreme_number(data: bytes, rng: np.random.Generator) -> bytes:
    """Write an extreme binary integer or float of 1 to 8 bytes."""
    if rng.random() < 0.5:
        size = int(rng.choice([1, 2, 4, 8]))
        number = (_choice(EXTREMES, rng) & (1 << 8 * size) - 1).to_bytes(
            size, "big" if rng.random() < 0.3 else "little"
        )
    else:
        value, kind = _choice(FLOATS, rng), str(rng.choice(["<f", ">f", "<d"]))
        number = struct.pack(
            kind,
            value
            if "d" in kind
            else np.clip(value, -3.4e38, 3.4e38)
            if np.isfinite(value)
            else value,
        )
    start = int(rng.integers(0, len(data)))
    return data[:start] + number + data[start + len(number) :]


def insert_token(data: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(0, len(data) + 1))
    return data[:at] + _choice(TOKENS, rng) + data[at:]


# ---- damage to text ------------------------------------------------------------------------------

WORD = re.compile(rb"[^\s\[\]{}(),:=\"']+")
NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def other_number(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a number in the text by an extreme one, such as a wrong count."""
    return _replaced(NUMBER, data, rng, lambda old: _choice(NUMBERS, rng))


def other_word(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a word by another word of the file or by a special token."""
    words = WORD.findall(data[:4096]) or [b"x"]
    return _replaced(
        WORD, data, rng, lambda old: _choice(words if rng.random() < 0.7 else TOKENS, rng)
    )


def line_operation(data: bytes, rng: np.random.Generator) -> bytes:
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


def _range(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    """Draw a range of bytes, usually a short one."""
    start = int(rng.integers(0, len(data)))
    return start, min(start + int(2 ** rng.uniform(0, 10)), len(data))


def _replaced(
    pattern: re.Pattern, data: bytes, rng: np.random.Generator, new: Callable[[bytes], bytes]
) -> bytes:
    """Replace one match near a random position."""
    at = int(rng.integers(0, len(data)))
    match = pattern.search(data, at) or pattern.search(data)
    return data if match is None else data[: match.start()] + new(match[0]) + data[match.end() :]


BINARY: list[Mutator] = [
    flip_bits,
    truncate,
    delete_block,
    duplicate_block,
    swap_blocks,
    overwrite_block,
    extreme_number,
    insert_token,
]
TEXT: list[Mutator] = [
    other_number,
    other_number,
    other_word,
    line_operation,
    flip_bits,
    delete_block,
    duplicate_block,
    insert_token,
    truncate,
]


def damaged(data: bytes, rng: np.random.Generator, mutators: list[Mutator]) -> bytes:
    """Apply one to four kinds of damage; the result has at most ``LARGEST`` bytes more."""
    for _ in range(1 if rng.random() < 0.5 else int(rng.integers(2, MOST_OPERATIONS + 1))):
        if data:
            data = _choice(mutators, rng)(data, rng)[: len(data) + LARGEST]
    return data


# ---- compressed and checksummed formats ----------------------------------------------------------


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


def _glb(pieces: list[tuple[str, bytes]]) -> bytes:
    chunks = b""
    for name, content in pieces:
        content += (b" " if name in JSON else b"\0") * (-len(content) % 4)
        chunks += (
            struct.pack("<I4s", len(content), name.encode("latin-1").ljust(4, b"\0")) + content
        )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _gunzip(data: bytes) -> list[tuple[str, bytes]]:
    return [("data", zlib.decompress(data, 16 + zlib.MAX_WBITS))]


def _gzip(pieces: list[tuple[str, bytes]]) -> bytes:
    deflate = zlib.compressobj(6, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    return deflate.compress(pieces[0][1]) + deflate.flush()


def _unply(data: bytes) -> list[tuple[str, bytes]]:
    head, end, body = data.partition(b"end_header\n")
    return [("header", head + end), ("body", body)]


def _joined(pieces: list[tuple[str, bytes]]) -> bytes:
    return b"".join(content for _, content in pieces)


JSON = ("JSON", "meta.json")
"""Names of pieces whose values are replaced one by one."""
ZIP = Packing(_unzip, _zip)
GZIP = Packing(_gunzip, _gzip)
GLB = Packing(_unglb, _glb, text=("JSON",))
PLY = Packing(_unply, _joined, text=("header",))


def json_value(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace one value of a JSON document by one of another type or size, or remove it."""
    try:
        document = json.loads(data)
        places = list(_places(document))
    except (ValueError, RecursionError):
        return other_word(data, rng)
    if not places:
        return data
    holder, key = places[rng.integers(len(places))]
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


UNPACKABLE = (
    *(ValueError, IndexError, OSError, zipfile.BadZipFile, zlib.error, struct.error),
    zstandard.ZstdError,
)


def mutant(
    seeds: list[bytes],
    rng: np.random.Generator,
    mutators: list[Mutator],
    packing: Optional[Packing],
) -> bytes:
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
    own = (
        [*TEXT, *[json_value] * 8] if name == "JSON" else TEXT if name in packing.text else mutators
    )
    pieces[at] = (name, damaged(content, rng, own))
    return packing.pack(pieces)
