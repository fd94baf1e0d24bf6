"""Fuzz targets: SOG, GLB with Gaussians, compressed PLY, .splat and SPZ of version 4."""

import io
import struct
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from PIL import Image

from tests.formats.test_ksplat import stored as ksplat_file
from tests.fuzz import mutations, oracles
from tests.fuzz.cloud_targets import some_gaussians
from tests.fuzz.target import cloud_of, require, require_picture, same, strictly
from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.splat import RECORD, read_splat
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians


def files(suffix: str, shapes: Sequence[tuple[int, int]], **options: Any) -> list[bytes]:
    """Write files of a format, of (count, degree) each."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        made = []
        for count, degree in shapes:
            cloud = StoredCloud(some_gaussians(count, degree), antialiased=degree == 1)
            write_cloud(str(path), cloud, **options)
            made.append(path.read_bytes())
        return made


def splats() -> list[bytes]:
    rows = np.zeros(11, RECORD)
    rng = np.random.default_rng(0)
    rows["mean"], rows["scale"] = rng.normal(size=(11, 3)), rng.random((11, 3))
    rows["rgba"], rows["quat"] = (rng.integers(0, 256, (11, 4)) for _ in range(2))
    return [rows.tobytes(), rows[:1].tobytes()]


def drawn(path: Path) -> Gaussians:
    """Read the drawable Gaussians of a file and render them."""
    gaussians = read_cloud(str(path)).gaussians
    if len(gaussians.means):
        require_picture(cloud_of(gaussians))
    return gaussians


def exercise_counted(count_of: Callable[[bytes], int]) -> Callable[[Path], None]:
    """Return a check that no more Gaussians are read than the strict reader finds in the file."""

    def exercise(path: Path) -> None:
        found, announced = len(drawn(path).means), strictly(count_of, path)
        require(found <= announced, f"{found} Gaussians, but the file says {announced}")

    return exercise


def exercise_splat(path: Path) -> None:
    read = read_splat(path)
    rows = np.frombuffer(path.read_bytes(), RECORD)
    same(read.means, rows["mean"], "means")
    with np.errstate(divide="ignore", invalid="ignore"):
        same(read.log_scales, np.log(rows["scale"]), "scales")
    drawn(path)


def exercise_means(
    read: Callable[[Path], Gaussians], means_of: Callable[[bytes], np.ndarray]
) -> Callable[[Path], None]:
    """Return a check that every position is the one that the strict reader finds."""

    def exercise(path: Path) -> None:
        found = read(path).means
        with np.errstate(over="ignore", invalid="ignore"):
            expected = strictly(means_of, path).astype(np.float32)
            close = np.isclose(found, expected, rtol=1e-4, atol=1e-4, equal_nan=True)
        require(found.shape == expected.shape, f"{len(found)} Gaussians, not {len(expected)}")
        require(bool(close.all()), "positions aren't those of the file")
        drawn(path)

    return exercise


def unpacked(path: Path) -> Path:
    """Unpack an archive beside itself; return its meta.json, which may be missing.

    Raises:
        UserError: it is no archive, or has names that aren't a file's.
    """
    try:
        for name, content in mutations.ZIP.unpack(path.read_bytes()):
            (path.parent / Path(name).name).write_bytes(content)
    except Exception as error:
        raise UserError(f"it can't be unpacked: {error}") from error
    return path.with_name("meta.json")


def ksplats() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.ksplat")
        return [
            ksplat_file(path, level, [ball(50, 1 + level % 2)]).read_bytes() for level in range(3)
        ]


def spz_count(data: bytes) -> int:
    """Return the count in the plain header of SPZ 4; versions before are gzip."""
    plain = data if data[:4] == b"NGSP" else oracles.gunzipped(data)
    return int.from_bytes(plain[8:12], "little")


def glb_count(data: bytes) -> int:
    """Return the sum of the counts of the positions, for each node that has a mesh."""
    document = oracles.glb_document(data)
    uses = sum("mesh" in node for node in document.get("nodes", []))
    primitives = [item for mesh in document.get("meshes", []) for item in mesh["primitives"]]
    places = [item.get("attributes", {}).get("POSITION") for item in primitives]
    return uses * sum(
        document["accessors"][place]["count"] for place in places if place is not None
    )


# ---- packings: damage below the compression ------------------------------------------------------


def _unsog(data: bytes) -> list[tuple[str, bytes]]:
    """Split an archive into its members, images as width, height and pixels."""
    pieces = []
    for name, content in mutations.ZIP.unpack(data):
        if name.endswith(".webp"):
            with Image.open(io.BytesIO(content)) as image:
                content = struct.pack("<HH", *image.size) + image.convert("RGBA").tobytes()
        pieces.append((name, content))
    return pieces


def _sog(pieces: list[tuple[str, bytes]]) -> bytes:
    packed = []
    for name, content in pieces:
        if name.endswith(".webp"):
            width, height = (
                (n - 1) % 64 + 1 for n in struct.unpack("<HH", content[:4].ljust(4, b"\0"))
            )
            pixels = content[4 : 4 + 4 * width * height].ljust(4 * width * height, b"\0")
            image, file = Image.frombytes("RGBA", (width, height), pixels), io.BytesIO()
            image.save(file, "WEBP", lossless=True, exact=True)
            content = file.getvalue()
        packed.append((name, content))
    return mutations.ZIP.pack(packed)


def _unspz(data: bytes) -> list[tuple[str, bytes]]:
    """Split SPZ 4 into its header, with the record of the axes, and unpacked blocks."""
    table = int.from_bytes(data[16:20], "little")
    pieces, at = [("header", data[:table])], table + 16 * data[15]
    for index in range(data[15]):
        size, unpacked = struct.unpack_from("<QQ", data, table + 16 * index)
        frame = zstandard.ZstdDecompressor().decompressobj().decompress(data[at : at + size])
        pieces.append((str(unpacked), frame))
        at += size
    return pieces


def _spz(pieces: list[tuple[str, bytes]]) -> bytes:
    header, *blocks = (content for _, content in pieces)
    frames = [zstandard.compress(block) for block in blocks]
    table = [struct.pack("<QQ", len(a), len(b)) for a, b in zip(frames, blocks, strict=True)]
    return b"".join([header, *table, *frames])


SOG = mutations.Packing(_unsog, _sog)
SPZ_4 = mutations.Packing(_unspz, _spz)
