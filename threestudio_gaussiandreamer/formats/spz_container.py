"""Containers of SPZ files: headers, packing of the blocks, and the checks before they are unpacked.

Versions 1 to 3 are one gzip member around header and blocks. Version 4 has a plain header of 32
bytes, extensions, of which only the record of the axes is written, a table of the packed and
unpacked size of each block (u64 each), and the blocks as Zstandard frames; a block without bytes is
left out."""

import io
import logging
import struct
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Integer

from ..core.errors import UserError
from ..core.file_memory import require_file_memory

logger = logging.getLogger(__name__)
HEADER, TABLE_OFFSET, ENTRY = (
    struct.Struct("<4sIIBBBB"),
    struct.Struct("<I12x"),
    struct.Struct("<QQ"),
)
MAGIC = b"NGSP"
VERSIONS = (3, 4)
"""Versions that can be written."""
GZIP_VERSIONS, ZSTD_VERSION = (1, 2, 3), 4
MAX_STORED_DEGREE = 4
ANTIALIASED, HAS_EXTENSIONS = 1, 2
"""Bits of the header's flags."""
RECORD = struct.Struct("<II")
"""Type and length of an extension, which its content follows."""
COORDINATES = 0xADBE0003
"""Type of SPZ_ADOBE_coordinate_system, the record of the axes."""
SYSTEMS = ("", *"LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split())
"""Directions of x, y and z by the number in that record: left, right, down, up, back, front."""
OWN_SYSTEM = "RUB"
MAX_EXTENSION_BYTES = 1 << 16
MOST_DEFLATE_SAVES = 1032
"""Bytes that one byte of a deflate stream stands for at most (zlib's technical notes)."""
MIN_WINDOW = 8 << 20
"""Bytes of a Zstandard window that every decoder accepts (RFC 8878, section 3.1.1.1.2)."""
ZSTD_LEVEL = 19
DECODED_BYTES, DECODED_BYTES_PER_HARMONIC = 180, 9
"""Bytes of memory that reading takes per Gaussian, and per harmonic of it, with a safety margin."""


class SpzHeader(NamedTuple):
    """The first 16 bytes, which all versions have."""

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

    @property
    def antialiased(self) -> bool:
        """Whether the Gaussians were trained with antialiasing."""
        return bool(self.flags & ANTIALIASED)


def pack(
    header: SpzHeader, blocks: Sequence[bytes], comment: str = "", system: str = OWN_SYSTEM
) -> bytes:
    """Pack the blocks of a file of version 3 or 4.

    Args:
        comment: ASCII text for the gzip header, which other readers ignore; version 4 has no place
            for it.
        system: the axes, one of ``SYSTEMS``, which version 4 records; version 3 has no others than
            the default.
    """
    if header.version != ZSTD_VERSION:
        return _gzip(HEADER.pack(*header) + b"".join(blocks), comment)
    compressor = _zstandard().ZstdCompressor(level=ZSTD_LEVEL, write_checksum=True)
    filled = [block for block in blocks if block]
    packed = [compressor.compress(block) for block in filled]
    flags = header.flags | HAS_EXTENSIONS
    head = HEADER.pack(*header._replace(flags=flags, streams=len(packed)))
    record = RECORD.pack(COORDINATES, 4) + SYSTEMS.index(system).to_bytes(4, "little")
    table = b"".join(ENTRY.pack(len(a), len(b)) for a, b in zip(packed, filled, strict=True))
    offset = HEADER.size + TABLE_OFFSET.size + len(record)
    return b"".join([head, TABLE_OFFSET.pack(offset), record, table, *packed])


def unpack(packed: bytes, name: str) -> tuple[SpzHeader, list[Integer[np.ndarray, "N B"]], str]:
    """Unpack header and blocks, and no more than the header's counts require; also return the
    axes, one of ``SYSTEMS``.

    Args:
        name: the file, for messages.

    Raises:
        UserError: no SPZ file of version 1 to 4, damaged, or more memory than the file's budget.
    """
    try:
        unpack_version = _unpack_zstd if packed[:4] == MAGIC else _unpack_gzip
        header, blocks, extensions = unpack_version(packed, name)
    except (zlib.error, struct.error) as error:
        fail(name, f"it isn't an SPZ file, or damaged ({error}).")
    system = _system(extensions, name) if header.flags & HAS_EXTENSIONS else OWN_SYSTEM
    shapes = [(header.count, size) for size in header.blocks]
    arrays = [np.frombuffer(data, "u1") for data in blocks]
    blocks = [array.reshape(shape) for array, shape in zip(arrays, shapes, strict=True)]
    return header, blocks, system


def _system(extensions: bytes, name: str) -> str:
    """Return the axes that the extensions record; warn about other extensions."""
    system, at = OWN_SYSTEM, 0
    while at + RECORD.size <= len(extensions):
        kind, length = RECORD.unpack_from(extensions, at)
        content = extensions[at + RECORD.size :][:length]
        at += RECORD.size + length
        number = int.from_bytes(content, "little")
        if kind != COORDINATES:
            logger.warning("SPZ file %r has vendor extension %#x, which is ignored", name, kind)
        elif length == 4 and 0 < number < len(SYSTEMS):
            system = SYSTEMS[number]
        else:
            fail(name, f"its record of the axes has the number {number}: 1 to 16 were expected.")
    return system


def require_version(version: int) -> None:
    """Raise UserError if files of this version can't be packed here."""
    if version not in VERSIONS:
        raise UserError(f"SPZ files of version {version} aren't written: choose 3 or 4")
    if version == ZSTD_VERSION:
        _zstandard()


def fail(name: str, problem: str) -> NoReturn:
    """Raise UserError about a file."""
    raise UserError(f"SPZ file {name!r}: {problem}")


def _check_header(header: SpzHeader, versions: tuple[int, ...], size: int, name: str) -> None:
    if header.magic != MAGIC or header.version not in versions:
        fail(name, "it isn't an SPZ file of version 1 to 4.")
    if header.degree > MAX_STORED_DEGREE:
        fail(name, f"harmonics of degree {header.degree} are announced: 0 to 4 were expected.")
    each = DECODED_BYTES + DECODED_BYTES_PER_HARMONIC * (header.degree + 1) ** 2
    what = f"{header.count} Gaussians"
    require_file_memory(each * header.count, size, f"SPZ file {name!r}", what)


# ---- versions 1 to 3 -----------------------------------------------------------------------------


def _unpack_gzip(packed: bytes, name: str) -> tuple[SpzHeader, list[memoryview], bytes]:
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    header = SpzHeader._make(HEADER.unpack(stream.decompress(packed, HEADER.size)))
    sizes = [size * header.count for size in header.blocks]
    if header.degree <= MAX_STORED_DEGREE and sum(sizes) > MOST_DEFLATE_SAVES * len(packed):
        what = f"{header.count} Gaussians are announced"
        fail(name, f"{what}, but {len(packed)} bytes can't hold them.")
    _check_header(header, GZIP_VERSIONS, len(packed), name)
    data = stream.decompress(stream.unconsumed_tail, sum(sizes)) if sum(sizes) else b""
    extensions = rest = stream.decompress(stream.unconsumed_tail, MAX_EXTENSION_BYTES)
    while not stream.eof and rest:  # read on to the checksum at the end
        rest = stream.decompress(stream.unconsumed_tail, MAX_EXTENSION_BYTES)
    if len(data) < sum(sizes):
        _fail_truncated(name, header, sum(sizes), len(data))
    if not stream.eof:
        fail(name, "its checksum at the end is missing: it is truncated.")
    view, ends = memoryview(data), np.cumsum(sizes)
    blocks = [view[end - size : end] for end, size in zip(ends, sizes, strict=True)]
    return header, blocks, extensions


def _fail_truncated(name: str, header: SpzHeader, size: int, found: int) -> NoReturn:
    fail(
        name,
        f"{header.count} Gaussians need {size} bytes, but {found} are there: it is truncated or "
        "damaged.",
    )


def _gzip(data: bytes, comment: str) -> bytes:
    """Compress to one gzip member (RFC 1952) without a time stamp, to make files reproducible."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    note = comment.encode("ascii") + b"\0" if comment else b""
    head = struct.pack("<4BIBB", 0x1F, 0x8B, 8, 16 if comment else 0, 0, 2, 255)
    return (
        head
        + note
        + deflate.compress(data)
        + deflate.flush()
        + struct.pack("<II", zlib.crc32(data), len(data) & 0xFFFFFFFF)
    )


# ---- version 4 -----------------------------------------------------------------------------------


def _unpack_zstd(packed: bytes, name: str) -> tuple[SpzHeader, list[bytes], bytes]:
    header = SpzHeader._make(HEADER.unpack_from(packed))
    _check_header(header, (ZSTD_VERSION,), len(packed), name)
    sizes = [size * header.count for size in header.blocks]
    frames = _frames(packed, header, [size for size in sizes if size], name)
    blocks = (_unpack_frame(*frame, name) for frame in frames)
    (table,) = TABLE_OFFSET.unpack_from(packed, HEADER.size)
    extensions = packed[HEADER.size + TABLE_OFFSET.size : table][:MAX_EXTENSION_BYTES]
    return header, [next(blocks) if size else b"" for size in sizes], extensions


def _frames(
    packed: bytes, header: SpzHeader, sizes: list[int], name: str
) -> list[tuple[bytes, int]]:
    """Return each packed block with its unpacked size, which must be one of ``sizes``."""
    (table,) = TABLE_OFFSET.unpack_from(packed, HEADER.size)
    at = table + ENTRY.size * header.streams
    if header.streams != len(sizes) or table < HEADER.size + TABLE_OFFSET.size or at > len(packed):
        fail(name, f"its table of {header.streams} blocks is damaged: {len(sizes)} were expected.")
    frames = []
    for index, size in enumerate(sizes):
        length, announced = ENTRY.unpack_from(packed, table + ENTRY.size * index)
        if announced != size or at + length > len(packed):
            _fail_truncated(name, header, size, min(announced, len(packed)))
        frames.append((packed[at : at + length], size))
        at += length
    if at != len(packed):
        fail(name, f"{len(packed) - at} bytes follow its last block: it is damaged.")
    return frames


def _unpack_frame(frame: bytes, size: int, name: str) -> bytes:
    zstd = _zstandard()
    reader = zstd.ZstdDecompressor(max_window_size=max(MIN_WINDOW, size))
    try:
        # reads on past ``size`` to the checksum; the frame's own size is not believed
        data = reader.stream_reader(io.BytesIO(frame)).read(size + 1)
    except zstd.ZstdError as error:
        fail(name, f"a block of it is damaged ({error}).")
    if len(data) != size:
        fail(name, f"a block of it has another size than {size} bytes: it is damaged.")
    return data


def _zstandard() -> Any:
    try:
        import zstandard
    except ImportError as error:
        raise UserError(
            "SPZ of version 4 is packed with Zstandard, which isn't installed: pip install "
            "zstandard (the extra [formats]); version 3 doesn't need it"
        ) from error
    return zstandard
