"""SPZ, the compact file of Gaussians that web viewers read: about 17 bytes for a Gaussian of degree
0, where a PLY takes 68.

The format is Niantic's (github.com/nianticlabs/spz, MIT). Version 3 is written, 2 and 3 are read;
both are gzip around a header and one block for each attribute. Integers are little-endian,
quaternions in the order xyzw, axes right, up, back:

==========  ========================================================================================
header      ``NGSP``, version u32, N u32, degree of the harmonics u8, fractional bits u8, flags u8
            (1: antialiased), 0
positions   N x 3 fixed point of 24 bit, signed
alphas      N u8: 255 opacity, written up to 254: Niantic's reader takes the logit of the byte over
            255, which is infinite at 255
colors      N x 3 u8: 255 (0.15 sh + 0.5)
scales      N x 3 u8: 16 (log scale + 10), so sizes from e^-10 to e^5.9 world units
rotations   N u32: the number of the largest component, and sign and 9 bit of each other (version 2:
            x y z u8)
harmonics   N x (K - 1) x 3 u8: 128 sh + 128, of which 5 bit are used at degree 1, 4 above
==========  ========================================================================================

The size in the header is checked against the file's size before anything is unpacked. The loss by
rounding is measured in docs/results.md."""

import logging
import os
import struct
import zlib
from math import ceil, log, log2, sqrt
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import UserError
from ..core.file_memory import require_file_memory
from ..core.files import atomic_file, existing_file
from ..gaussians.gaussians import Gaussians, finite, usable

logger = logging.getLogger(__name__)
HEADER = struct.Struct("<4sIIBBBB")
MAGIC, VERSION = b"NGSP", 3
SPZ_UP = "y"
STEPS_PER_SIZE = 32
"""Resolution of positions: steps per median size of the Gaussians. More steps hardly improve the
PSNR (docs/results.md).
"""
MIN_STEPS_PER_SIZE = 2
INLIERS, OUTLIER = 0.99, 256
"""If the range of the farthest position would leave fewer than ``MIN_STEPS_PER_SIZE`` steps per
median size, positions beyond ``OUTLIER`` times the ``INLIERS`` quantile of distances are clipped.
"""
MOST_DEFLATE_SAVES = 1032
"""Bytes that one byte of a deflate stream stands for at most (zlib's technical notes)."""
MAX_OPACITY_BYTE = 254
COLOR_SCALE = 0.15
MAX_FIXED = 2**23 - 1
COLOR_REACH = 0.5 / COLOR_SCALE
"""Largest absolute value of a stored constant harmonic: colours from -0.44 to 1.44."""
MIN_LOG_SCALE, MAX_LOG_SCALE = -10.0, 255 / 16 - 10
SH_BITS = (5, 4, 4)
"""Bits per coefficient, for degree 1, 2 and 3."""
DECODED_BYTES, DECODED_BYTES_PER_HARMONIC = 180, 9
"""Bytes of memory that reading takes per Gaussian, and per harmonic of it, with a safety margin."""
OPACITY_MARGIN = 1 / 2040
"""Opacities that are read are clamped to this distance from 0 and 1, an eighth of a step, since
their logits are infinite there.
"""


class SpzHeader(NamedTuple):
    """The header of an SPZ file."""

    magic: bytes
    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    reserved: int

    @property
    def blocks(self) -> list[int]:
        """Bytes per Gaussian of positions, alphas, colours, scales, rotations and harmonics."""
        return [9, 1, 3, 3, 4 if self.version == 3 else 3, 3 * ((self.degree + 1) ** 2 - 1)]


def write_spz(path: str | os.PathLike, gaussians: Gaussians, *, comment: str = "") -> None:
    """Write :func:`spz_bytes` atomically.

    Gaussians that aren't finite are left out, with a warning. Values beyond the format's range are
    clipped, with a warning for positions and for scales above the range.

    Raises:
        UserError: harmonics above degree 3, or the file can't be written.
    """
    gaussians = finite(gaussians, str(path))
    data = spz_bytes(gaussians, comment=comment)
    if clipped := int(out_of_range(gaussians).sum()):
        logger.warning(
            "%s: %d of %d Gaussians are farther away or larger than SPZ can hold: clipped to its "
            "range",
            path,
            clipped,
            len(gaussians.means),
        )
    with atomic_file(path) as file:
        file.write(data)


def spz_bytes(gaussians: Gaussians, *, comment: str = "") -> bytes:
    """Encode Gaussians as an SPZ file of version 3.

    They are sorted along a Morton curve, which improves the compression. Positions and scales
    beyond the format's range are clipped.

    Args:
        gaussians: in the axes right, up, back.
        comment: ASCII text for the gzip header, which other readers ignore.

    Raises:
        UserError: values are NaN or infinite, or harmonics are above degree 3.
    """
    if not usable(gaussians).all():
        raise UserError("an SPZ file can't hold Gaussians with NaN or infinite values")
    if gaussians.sh_degree > 3:
        raise UserError(f"an SPZ file holds harmonics up to degree 3, not {gaussians.sh_degree}")
    gaussians = gaussians.rows(_morton_order(gaussians.means))
    fractional = _fractional_bits(gaussians)
    count = len(gaussians.means)
    header = HEADER.pack(MAGIC, VERSION, count, gaussians.sh_degree, fractional, 0, 0)
    blocks = [
        _fixed_point(gaussians.means, fractional),
        _to_byte(255 * _opacities(gaussians.logit_opacities)).clip(max=MAX_OPACITY_BYTE),
        _to_byte(255 * (COLOR_SCALE * gaussians.sh[:, 0] + 0.5)),
        _to_byte(16 * (gaussians.log_scales - MIN_LOG_SCALE)),
        _smallest_three(gaussians.quats),
        _harmonic_bytes(gaussians.sh[:, 1:]),
    ]
    return _gzip(
        header + b"".join(np.ascontiguousarray(block).tobytes() for block in blocks), comment
    )


def out_of_range(gaussians: Gaussians) -> Bool[np.ndarray, " N"]:
    """Return which Gaussians have a position or a scale above the format's range."""
    reach = MAX_FIXED * 2.0 ** -_fractional_bits(gaussians)
    far = (np.abs(gaussians.means) > reach).any(axis=1)
    return far | (gaussians.log_scales > MAX_LOG_SCALE + 1 / 32).any(axis=1)


def read_spz(path: str | os.PathLike) -> Gaussians:
    """Read the Gaussians of an SPZ file of version 2 or 3, in its axes: right, up, back.

    Raises:
        UserError: there is no such file, it is no SPZ file of these versions, or it is damaged.
    """
    path = existing_file(path, "SPZ file")
    try:
        return spz_arrays(path.read_bytes(), str(path))
    except OSError as error:
        raise UserError(f"cannot read {str(path)!r}: {error.strerror or error}.") from error


def spz_arrays(packed: bytes, name: str = "") -> Gaussians:
    """Decode the bytes of an SPZ file; ``name`` is for messages. See :func:`read_spz`."""
    header, data = _unpacked(packed, name)
    ends = np.cumsum([size * header.count for size in header.blocks])
    parts = [
        part.reshape(header.count, size)
        for part, size in zip(np.split(data, ends[:-1]), header.blocks, strict=True)
    ]
    positions, alphas, colors, scales, rotations, harmonics = parts
    read_quats = _from_smallest_three if header.version == 3 else _from_first_three
    return Gaussians(
        means=_positions(positions, header.fractional_bits),
        quats=read_quats(rotations),
        log_scales=scales / np.float32(16) + np.float32(MIN_LOG_SCALE),
        logit_opacities=_logits(alphas[:, 0]),
        sh=_harmonics(colors, harmonics),
    )


def read_spz_comment(path: str | os.PathLike) -> str:
    """Read the comment that :func:`spz_bytes` writes; empty if there is none."""
    with open(path, "rb") as file:
        head = file.read(4096)
    has_comment_alone = head[:2] == b"\x1f\x8b" and head[3:4] == b"\x10"
    return head[10:].partition(b"\0")[0].decode("latin-1") if has_comment_alone else ""


def _unpacked(packed: bytes, name: str) -> tuple[SpzHeader, Int[np.ndarray, " B"]]:
    """Unpack the header, and no more data than its counts require."""
    if packed[:4] == MAGIC:
        _fail(
            name,
            "version 4, packed with Zstandard, isn't known here: versions 2 and 3 are. "
            "Niantic's tools write version 3 too.",
        )
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        header = SpzHeader._make(HEADER.unpack(stream.decompress(packed, HEADER.size)))
        _check_header(header, len(packed), name)
        size = sum(header.blocks) * header.count
        data = stream.decompress(stream.unconsumed_tail, size) if size else b""
        while not stream.eof and stream.decompress(stream.unconsumed_tail, 1 << 16):
            # read on to the checksum at the end: extensions may follow the blocks
            pass
    except (zlib.error, struct.error) as error:
        _fail(name, f"it isn't an SPZ file, or damaged ({error}).")
    if len(data) < size or not stream.eof:
        _fail(
            name,
            f"{header.count} Gaussians need {size} bytes, but {len(data)} are there: it is "
            "truncated or damaged.",
        )
    return header, np.frombuffer(data, "u1")


def _check_header(header: SpzHeader, packed_size: int, name: str) -> None:
    if header.magic != MAGIC or header.version not in (2, 3):
        _fail(name, "it isn't an SPZ file of version 2 or 3.")
    if header.degree > 3:
        _fail(name, f"harmonics of degree {header.degree} are announced: 0 to 3 were expected.")
    if sum(header.blocks) * header.count > MOST_DEFLATE_SAVES * packed_size:
        _fail(
            name,
            f"{header.count} Gaussians are announced, but {packed_size} bytes can't hold them.",
        )
    each = DECODED_BYTES + DECODED_BYTES_PER_HARMONIC * (header.degree + 1) ** 2
    what = f"{header.count} Gaussians"
    require_file_memory(each * header.count, packed_size, f"SPZ file {name!r}", what)


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


# ---- the attributes as SPZ stores them -----------------------------------------------------------


def _morton_order(means: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """Return the rows in Morton order: by the interleaved bits of positions, 10 bits per axis."""
    means = means.astype(np.float64)
    low, high = means.min(axis=0, initial=np.inf), means.max(axis=0, initial=-np.inf)
    cells = ((means - low) / np.maximum(high - low, 1e-12) * 1023).astype(np.int64)
    bits = cells[:, :, None] >> np.arange(10) & 1
    return (
        (bits << (3 * np.arange(10) + np.arange(3)[:, None]))
        .sum(axis=(1, 2))
        .argsort(kind="stable")
    )


def _fractional_bits(gaussians: Gaussians) -> int:
    """Choose the number of fractional bits from the Gaussians' size; fewer if large positions need
    more of the 23 bits for the integer part.
    """
    if not len(gaussians.means):
        return 1  # some readers refuse 0
    distances = np.abs(gaussians.means).max(axis=1)
    inliers = float(np.quantile(distances, INLIERS, method="lower"))
    log2_size = float(np.median(gaussians.log_scales.clip(-50, 50).mean(axis=1))) / log(2)
    fewest, wanted = (ceil(log2(n) - log2_size) for n in (MIN_STEPS_PER_SIZE, STEPS_PER_SIZE))
    room = _room(float(distances.max()))
    if room < fewest:
        room = max(room, _room(OUTLIER * inliers))
    return max(0, min(room, max(1, wanted), 30))


def _room(reach: float) -> int:
    """Return how many of 23 bits can be fractional for coordinates up to ``reach``."""
    return 23 - ceil(log2(max(reach, 2.0**-40) * (1 + 1e-6)))


def _fixed_point(means: Float[np.ndarray, "N 3"], fractional_bits: int) -> Int[np.ndarray, "N 9"]:
    fixed = np.rint(means.astype(np.float64) * 2.0**fractional_bits)
    low_bytes = fixed.clip(-MAX_FIXED, MAX_FIXED).astype("<i4")[..., None].view("u1")[..., :3]
    return low_bytes.reshape(-1, 9)


def _positions(block: Int[np.ndarray, "N 9"], fractional_bits: int) -> Float[np.ndarray, "N 3"]:
    low, middle, high = block.reshape(-1, 3, 3).transpose(2, 0, 1).astype(np.int32)
    fixed = low | middle << 8 | (high ^ 0x80) - 0x80 << 16
    return (fixed * 2.0**-fractional_bits).astype(np.float32)


def _smallest_three(quats: Float[np.ndarray, "N 4"]) -> Int[np.ndarray, " N"]:
    xyzw = _unit(quats)[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(xyzw[np.arange(len(xyzw)), largest] < 0, -1, 1)[:, None]
    others = xyzw[np.arange(4) != largest[:, None]].reshape(-1, 3)
    fields = (
        np.rint(np.abs(others) * (511 * sqrt(2))).astype(np.int64).clip(0, 511) | (others < 0) << 9
    )
    return (largest << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")


def _from_smallest_three(block: Int[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    word = np.ascontiguousarray(block).view("<u4").astype(np.int64)
    fields = word >> np.array([20, 10, 0]) & 1023
    others = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / (511 * sqrt(2))
    xyzw = np.empty((len(block), 4))
    missing = np.arange(4) == word >> 30
    xyzw[~missing] = others.ravel()
    xyzw[missing] = np.sqrt(np.clip(1 - (others**2).sum(axis=1), 0, 1))
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)


def _from_first_three(block: Int[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    xyz = block / 127.5 - 1
    w = np.sqrt(np.clip(1 - (xyz**2).sum(axis=1, keepdims=True), 0, 1))
    return np.concatenate([w, xyz], axis=1).astype(np.float32)


def _harmonics(
    colors: Int[np.ndarray, "N 3"], rest: Int[np.ndarray, "N R"]
) -> Float[np.ndarray, "N K 3"]:
    """Decode the harmonics; in place, since they are most of the memory."""
    sh = np.empty((len(colors), 1 + rest.shape[1] // 3, 3), np.float32)
    sh[:, 0] = (colors / np.float32(255) - np.float32(0.5)) / np.float32(COLOR_SCALE)
    sh[:, 1:] = rest.reshape(len(rest), -1, 3) if rest.size else 0
    sh[:, 1:] -= 128
    sh[:, 1:] /= 128
    return sh


def _harmonic_bytes(rest: Float[np.ndarray, "N K 3"]) -> Int[np.ndarray, "N K 3"]:
    """Encode harmonics with zero at 128, rounded to the step of each degree, which compresses
    better.
    """
    degrees = np.sqrt(np.arange(1, rest.shape[1] + 1)).astype(int) - 1
    steps = 2 ** (8 - np.array(SH_BITS))[degrees][:, None]
    return _to_byte(np.floor((np.rint(128 * rest) + 128 + steps // 2) / steps) * steps)


def _unit(quats: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Normalise in float64; a zero quaternion becomes the identity."""
    quats = np.array(quats, np.float64)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1), [1.0, 0, 0, 0])


def _opacities(logits: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    from scipy.special import expit

    return expit(logits.astype(np.float64))


def _logits(alphas: Int[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    from scipy.special import logit

    return logit(np.clip(alphas / 255, OPACITY_MARGIN, 1 - OPACITY_MARGIN)).astype(np.float32)


def _to_byte(values: Float[np.ndarray, "*shape"]) -> Int[np.ndarray, "*shape"]:
    return np.rint(np.clip(values, 0, 255)).astype("u1")


def _fail(name: str, problem: str) -> NoReturn:
    raise UserError(f"SPZ file {name!r}: {problem}")
