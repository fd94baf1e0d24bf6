"""SPZ, the compact file of Gaussians that web viewers read, Niantic's (github.com/nianticlabs/spz,
MIT). Versions 3 and 4 are written, 1 to 4 are read: a header and one block for each attribute.
Quaternions are xyzw. Axes are right, up, back unless a record says others
(SPZ_ADOBE_coordinate_system), which version 4 can have when written.

Versions 1 to 3 are one gzip member around header and blocks. Version 4 has a plain header of 32
bytes, extensions, of which only the record of the axes is written, a table of the packed and
unpacked size of each block (u64 each), and the blocks as Zstandard frames; a block without bytes is
left out. The size in the header is checked against the file's before anything is unpacked."""

import io
import logging
import os
import struct
import zlib
from collections.abc import Sequence
from math import ceil, log, log2, sqrt
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer

from ..core.errors import UserError
from ..core.files import write_file
from ..gaussians.axes import rotate
from ..gaussians.gaussians import Gaussians, finite, usable
from . import packing
from .packing import ANTIALIASED
from .reading import reading, require, require_file_memory

logger = logging.getLogger(__name__)
HEADER, TABLE_OFFSET = struct.Struct("<4sIIBBBB"), struct.Struct("<I12x")
ENTRY, RECORD = struct.Struct("<QQ"), struct.Struct("<II")
"""Of the table: packed and unpacked size; of an extension: type and length."""
MAGIC, MAX_STORED_DEGREE, ZSTD_VERSION = b"NGSP", 4, 4
VERSIONS, VERSION = (3, 4), 3
"""Versions that can be written, and the one that is by default."""
IS_ANTIALIASED, HAS_EXTENSIONS = 1, 2
"""Bits of the header's flags."""
COORDINATES = 0xADBE0003
"""Type of SPZ_ADOBE_coordinate_system, the record of the axes."""
SYSTEMS = ("", *"LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split())
"""Directions of x, y and z by the number in that record: left, right, down, up, back, front."""
OWN_SYSTEM, SPZ_UP = "RUB", "y"
DIRECTIONS = dict(zip("RUBLDF", np.concatenate([np.eye(3), -np.eye(3)]), strict=True))
"""Right, up, back and their opposites, in the file's usual axes."""
SYSTEM_OF = {SPZ_UP: OWN_SYSTEM, "-y": "RDF"}
"""Axes that can be written, by the axis that is up."""
MAX_EXTENSION_BYTES, ZSTD_LEVEL = 1 << 16, 19
DECODED_BYTES, DECODED_BYTES_PER_HARMONIC = 180, 9
"""Bytes of memory that reading takes per Gaussian, and per harmonic of it, with a safety margin."""
MIN_STEPS_PER_SIZE, STEPS_PER_SIZE = 2, 32
"""Steps of positions per median size of the Gaussians; more bring little (reports/answered.md)."""
INLIER_QUANTILE, OUTLIER_FACTOR = 0.99, 256
"""Where the farthest position would leave fewer than ``MIN_STEPS_PER_SIZE`` steps, positions beyond
``OUTLIER_FACTOR`` times this quantile of distances are clipped.
"""
MAX_FIXED, COLOR_SCALE = 2**23 - 1, 0.15
COLOR_REACH = 0.5 / COLOR_SCALE
"""Largest absolute value of a stored constant harmonic: colours from -0.44 to 1.44."""
MIN_LOG_SCALE, MAX_LOG_SCALE = -10.0, 255 / 16 - 10
SH_BITS = (5, 4, 4)
"""Bits per coefficient, for degree 1, 2 and 3."""


class SpzHeader(NamedTuple):
    magic: bytes
    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    streams: int
    """Number of packed blocks in version 4, 0 before."""

    @property
    def blocks(self) -> list[int]:
        """Bytes per Gaussian of positions, alphas, colours, scales, rotations and harmonics."""
        position, rotation = 6 if self.version == 1 else 9, 3 if self.version < 3 else 4
        return [position, 1, 3, 3, rotation, 3 * ((self.degree + 1) ** 2 - 1)]


def write_spz(
    path: str | os.PathLike,
    gaussians: Gaussians,
    notes: Sequence[str] = (),
    *,
    version: int = VERSION,
    up: str = SPZ_UP,
) -> None:
    """Write :func:`spz_bytes` atomically, without Gaussians that aren't finite, and with a warning
    where positions and scales are clipped.
    """
    gaussians = finite(gaussians, str(path))
    data = spz_bytes(gaussians, notes, version=version, up=up)
    if clipped := int(out_of_range(gaussians).sum()):
        said = "%s: %d of %d Gaussians are farther away or larger than SPZ can hold: clipped to its"
        logger.warning(f"{said} range", path, clipped, len(gaussians.means))
    write_file(path, data)


def spz_bytes(
    gaussians: Gaussians, notes: Sequence[str] = (), *, version: int = VERSION, up: str = SPZ_UP
) -> bytes:
    """Encode Gaussians as an SPZ file, along a Morton curve, which improves the compression.
    Positions and scales beyond the format's range are clipped.

    Args:
        gaussians: in the axes right, up, back, or with another axis ``up``.
        notes: ASCII texts for the gzip header, which other readers ignore and version 4 lacks;
            ``packing.ANTIALIASED`` sets the header's flag.
        version: 3 or 4.
        up: a key of ``SYSTEM_OF``, which version 4 records; version 3 can only have the default.

    Raises:
        UserError: values aren't finite, harmonics are above degree 3, or Zstandard is missing.
    """
    if not usable(gaussians).all():
        raise UserError("an SPZ file can't hold NaN or infinity")
    if gaussians.sh_degree > 3:
        raise UserError(f"an SPZ file holds harmonics up to degree 3, not {gaussians.sh_degree}")
    gaussians = gaussians.rows(packing.morton_order(gaussians.means))
    fractional = _fractional_bits(gaussians)
    fixed = np.rint(gaussians.means.astype(np.float64) * 2.0**fractional)
    fixed = fixed.clip(-MAX_FIXED, MAX_FIXED).astype("<i4")
    largest, others = packing.without_largest(packing.unit_quats(gaussians.quats)[:, [1, 2, 3, 0]])
    sizes = np.rint(np.abs(others) * (511 * sqrt(2))).astype(np.int64).clip(0, 511)
    fields = (sizes | (others < 0) << 9) << np.array([20, 10, 0])
    # zero harmonics are 128; they are rounded to the step of each degree, which compresses better
    degrees = np.sqrt(np.arange(1, gaussians.sh.shape[1])).astype(int) - 1
    steps = 2 ** (8 - np.array(SH_BITS))[degrees][:, None]
    rest = np.floor((np.rint(128 * gaussians.sh[:, 1:]) + 128 + steps // 2) / steps) * steps
    blocks = [
        fixed[..., None].view("u1")[..., :3],  # the three low bytes
        packing.opacity_bytes(gaussians.logit_opacities),
        packing.to_byte(255 * (COLOR_SCALE * gaussians.sh[:, 0] + 0.5)),
        packing.to_byte(16 * (gaussians.log_scales - MIN_LOG_SCALE)),
        (largest << 30 | fields.sum(axis=1)).astype("<u4"),
        packing.to_byte(rest),
    ]
    flags, degree = IS_ANTIALIASED if ANTIALIASED in notes else 0, gaussians.sh_degree
    header = SpzHeader(MAGIC, version, len(gaussians.means), degree, fractional, flags, 0)
    packed = [np.ascontiguousarray(block).tobytes() for block in blocks]
    if version == ZSTD_VERSION:
        return _zstd(header, packed, SYSTEM_OF[up])
    # one gzip member (RFC 1952) without a time stamp, so that files are reproducible
    data = HEADER.pack(*header) + b"".join(packed)
    comment = "; ".join(note for note in notes if note != ANTIALIASED).encode("ascii")
    head = struct.pack("<4BIBB", 0x1F, 0x8B, 8, 16 if comment else 0, 0, 2, 255)
    deflate = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    content = deflate.compress(data) + deflate.flush()
    checksum = struct.pack("<II", zlib.crc32(data), len(data) & 0xFFFFFFFF)
    return head + (comment and comment + b"\0") + content + checksum


def position_step(gaussians: Gaussians) -> float:
    """Return the difference of neighbouring positions in a file of these Gaussians."""
    return 2.0 ** -_fractional_bits(gaussians)


def out_of_range(gaussians: Gaussians) -> Bool[np.ndarray, " N"]:
    """Return which Gaussians have a position or a scale above the format's range."""
    reach = MAX_FIXED * position_step(gaussians)
    far = (np.abs(gaussians.means) > reach).any(axis=1)
    return far | (gaussians.log_scales > MAX_LOG_SCALE + 1 / 32).any(axis=1)


def read_spz(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read the Gaussians of an SPZ file of version 1 to 4, right, up, back, and its notes.

    Raises:
        UserError: there is no such file, it is no SPZ file of these versions, or it is damaged.
    """
    with reading(path, "SPZ file") as file:
        data = file.read_bytes()
        gaussians, antialiased = spz_arrays(data)
    has_comment_alone = data[:2] == b"\x1f\x8b" and data[3:4] == b"\x10"
    comment = data[10:4096].partition(b"\0")[0].decode("latin-1") if has_comment_alone else ""
    return gaussians, comment.split("; ") + [ANTIALIASED] * antialiased


def spz_arrays(packed: bytes) -> tuple[Gaussians, bool]:
    """Decode the bytes of an SPZ file, inside :func:`reading` if it may be damaged; also return
    whether it was trained antialiased.
    """
    unpack = _unpack_zstd if packed[:4] == MAGIC else _unpack_gzip
    header, data, extensions = unpack(packed)
    view, ends = np.frombuffer(data, "u1"), header.count * np.cumsum([0, *header.blocks])
    positions, alphas, colors, scales, rotations, harmonics = (
        view[start:end].reshape(header.count, width)
        for start, end, width in zip(ends, ends[1:], header.blocks, strict=False)
    )
    means, quats = _means(positions, header), _quats(rotations, header)
    log_scales = scales / np.float32(16)
    logits = packing.logits_of_bytes(alphas[:, 0])
    # the harmonics last and in place, since they are most of the memory
    sh = np.empty((header.count, 1 + harmonics.shape[1] // 3, 3), np.float32)
    sh[:, 0] = (colors / np.float32(255) - np.float32(0.5)) / np.float32(COLOR_SCALE)
    sh[:, 1:] = harmonics.reshape(header.count, -1, 3) if harmonics.size else 0
    sh[:, 1:] -= 128
    sh[:, 1:] /= 128
    gaussians = Gaussians(means, quats, log_scales + np.float32(MIN_LOG_SCALE), logits, sh)
    system = _system(extensions) if header.flags & HAS_EXTENSIONS else OWN_SYSTEM
    if system != OWN_SYSTEM:
        gaussians = rotate(gaussians, np.stack([DIRECTIONS[x] for x in system], axis=1))
    return gaussians, bool(header.flags & IS_ANTIALIASED)


def _means(block: Integer[np.ndarray, "N B"], header: SpzHeader) -> Float[np.ndarray, "N 3"]:
    if header.version == 1:
        return block.view("<f2").astype(np.float32)
    low, middle, high = block.reshape(-1, 3, 3).transpose(2, 0, 1).astype(np.int32)
    fixed = low | middle << 8 | (high ^ 0x80) - 0x80 << 16
    return (fixed * 2.0**-header.fractional_bits).astype(np.float32)


def _quats(block: Integer[np.ndarray, "N B"], header: SpzHeader) -> Float[np.ndarray, "N 4"]:
    if header.version < 3:
        xyz = block / 127.5 - 1
        w = np.sqrt(np.clip(1 - (xyz**2).sum(axis=1, keepdims=True), 0, 1))
        return np.concatenate([w, xyz], axis=1).astype(np.float32)
    word = np.ascontiguousarray(block).view("<u4").astype(np.int64)
    fields = word >> np.array([20, 10, 0]) & 1023
    others = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / (511 * sqrt(2))
    return packing.with_largest(word[:, 0] >> 30, others)[:, [3, 0, 1, 2]]


def _fractional_bits(gaussians: Gaussians) -> int:
    """Choose the fractional bits by the Gaussians' size, of the 23 that positions have."""
    if not len(gaussians.means):
        return 1  # some readers refuse 0
    distances = np.abs(gaussians.means).max(axis=1)
    inliers = float(np.quantile(distances, INLIER_QUANTILE, method="lower"))
    log2_size = float(np.median(gaussians.log_scales.clip(-50, 50).mean(axis=1))) / log(2)
    fewest, wanted = (ceil(log2(n) - log2_size) for n in (MIN_STEPS_PER_SIZE, STEPS_PER_SIZE))
    room, inner = (
        23 - ceil(log2(max(reach, 2.0**-40) * (1 + 1e-6)))
        for reach in (float(distances.max()), OUTLIER_FACTOR * inliers)
    )
    room = max(room, inner) if room < fewest else room
    return max(0, min(room, max(1, wanted), 30))


def require_version(version: int) -> None:
    """Raise UserError if files of this version can't be packed here."""
    if version not in VERSIONS:
        raise UserError(f"SPZ files of version {version} aren't written: choose 3 or 4")
    if version == ZSTD_VERSION:
        _zstandard()


def _check(header: SpzHeader, versions: Sequence[int], size: int) -> None:
    known = header.magic == MAGIC and header.version in versions
    require(known, "it isn't an SPZ file of version 1 to 4")
    degree = f"harmonics of degree {header.degree} are announced: 0 to 4 were expected"
    require(header.degree <= MAX_STORED_DEGREE, degree)
    each = DECODED_BYTES + DECODED_BYTES_PER_HARMONIC * (header.degree + 1) ** 2
    require_file_memory(each * header.count, size, f"{header.count} Gaussians")


def _system(extensions: bytes) -> str:
    """Return the axes that the extensions record; warn about other extensions."""
    system, at = OWN_SYSTEM, 0
    while at + RECORD.size <= len(extensions):
        kind, length = RECORD.unpack_from(extensions, at)
        number = int.from_bytes(extensions[at + RECORD.size :][:length], "little")
        at += RECORD.size + length
        if kind == COORDINATES:
            usual = length == 4 and 0 < number < len(SYSTEMS)
            require(usual, f"its record of the axes has the number {number}: 1 to 16 were expected")
            system = SYSTEMS[number]
        else:
            logger.warning("an SPZ file has vendor extension %#x, which is ignored", kind)
    return system


def _unpack_gzip(packed: bytes) -> tuple[SpzHeader, bytes, bytes]:
    """Return header, blocks and extensions of versions 1 to 3, no more than the counts require."""
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    header = SpzHeader._make(HEADER.unpack(stream.decompress(packed, HEADER.size)))
    _check(header, (1, 2, 3), len(packed))
    size = header.count * sum(header.blocks)
    data = stream.decompress(stream.unconsumed_tail, size) if size else b""
    extensions = rest = stream.decompress(stream.unconsumed_tail, MAX_EXTENSION_BYTES)
    while not stream.eof and rest:  # read on to the checksum at the end
        rest = stream.decompress(stream.unconsumed_tail, MAX_EXTENSION_BYTES)
    require(len(data) == size and stream.eof, "it is truncated")
    return header, data, extensions


def _zstd(header: SpzHeader, blocks: Sequence[bytes], system: str) -> bytes:
    compressor = _zstandard().ZstdCompressor(level=ZSTD_LEVEL, write_checksum=True)
    filled = [block for block in blocks if block]
    packed = [compressor.compress(block) for block in filled]
    flags = header.flags | HAS_EXTENSIONS
    head = HEADER.pack(*header._replace(flags=flags, streams=len(packed)))
    record = RECORD.pack(COORDINATES, 4) + SYSTEMS.index(system).to_bytes(4, "little")
    table = b"".join(ENTRY.pack(len(a), len(b)) for a, b in zip(packed, filled, strict=True))
    offset = HEADER.size + TABLE_OFFSET.size + len(record)
    return b"".join([head, TABLE_OFFSET.pack(offset), record, table, *packed])


def _unpack_zstd(packed: bytes) -> tuple[SpzHeader, bytes, bytes]:
    header = SpzHeader._make(HEADER.unpack_from(packed))
    _check(header, (ZSTD_VERSION,), len(packed))
    sizes = [size * header.count for size in header.blocks if size * header.count]
    (table,) = TABLE_OFFSET.unpack_from(packed, HEADER.size)
    start, at = HEADER.size + TABLE_OFFSET.size, table + ENTRY.size * header.streams
    require(header.streams == len(sizes) and table >= start, "its table of blocks is damaged")
    entries = [ENTRY.unpack_from(packed, table + ENTRY.size * i) for i in range(len(sizes))]
    whole = at + sum(length for length, _ in entries) == len(packed)
    require(whole and [size for _, size in entries] == sizes, "it is truncated or damaged")
    blocks = []
    for length, size in entries:
        # RFC 8878, 3.1.1.1.2: every decoder accepts windows of 8 MiB
        reader = _zstandard().ZstdDecompressor(max_window_size=max(8 << 20, size))
        # reads on past ``size`` to the checksum; the frame's own size is not believed
        blocks += [reader.stream_reader(io.BytesIO(packed[at : at + length])).read(size + 1)]
        usual = len(blocks[-1]) == size
        require(usual, "a block of it is of another size than announced: it is damaged")
        at += length
    return header, b"".join(blocks), packed[start:table][:MAX_EXTENSION_BYTES]


def _zstandard() -> Any:
    try:
        import zstandard
    except ImportError as error:
        raise UserError(
            "SPZ of version 4 is packed with Zstandard, which isn't installed: pip install "
            "zstandard (the extra [formats]); version 3 doesn't need it"
        ) from error
    return zstandard
