"""Second readers of the compact formats of Gaussians, as ``oracles.py`` has them of the others."""

import io
import json
import re
import struct
import zipfile

import numpy as np
from PIL import Image

from tests.fuzz.oracles import Illegal, ply_header


def compressed_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in a compressed PLY: 11, 10 and 11 bits between the limits of 256."""
    encoding, elements, body = ply_header(data)
    if encoding == "ascii":
        raise Illegal("text")
    order, at, tables = "<" if "little" in encoding else ">", 0, {}
    for name, count, properties in elements:
        row = struct.Struct(order + "".join(kind for _, kind, _ in properties))
        if at + count * row.size > len(body):
            raise Illegal("truncated")
        names = [entry[0] for entry in properties]
        rows = (row.unpack_from(body, at + i * row.size) for i in range(count))
        tables[name] = [dict(zip(names, values, strict=True)) for values in rows]
        at += count * row.size
    return np.array(
        [
            _between_limits(vertex["packed_position"], tables["chunk"][index // 256])
            for index, vertex in enumerate(tables["vertex"])
        ]
    ).reshape(-1, 3)


def _between_limits(word: int, chunk: dict[str, float]) -> list[float]:
    fractions = [(word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047]
    return [
        chunk[f"min_{axis}"] * (1 - fraction) + chunk[f"max_{axis}"] * fraction
        for axis, fraction in zip("xyz", fractions, strict=True)
    ]


def sog_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in a SOG archive whose images Pillow decodes."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        meta = json.loads(archive.read("meta.json"))
        means, count = meta["means"], meta["count"]
        images = [Image.open(io.BytesIO(archive.read(name))) for name in means["files"][:2]]
    low, high = (np.array(image.convert("RGB"), int).reshape(-1, 3)[:count] for image in images)
    start, end = (np.array(means[key], float) for key in ("mins", "maxs"))
    logs = start + (end - start) * ((high * 256 + low) / 65535)
    return np.sign(logs) * (np.exp(np.abs(logs)) - 1)


def ksplat_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in the records of a .ksplat file."""
    sections, level = struct.unpack_from("<I", data, 4)[0], struct.unpack_from("<H", data, 20)[0]
    at, means = 4096 + 1024 * sections, []
    for index in range(sections):
        count, room, bucket, buckets, block, stride = struct.unpack_from(
            "<IIIIfH", data, 4096 + 1024 * index
        )
        steps, _, full, partial = struct.unpack_from("<4I", data, 4096 + 1024 * index + 24)
        degree = struct.unpack_from("<H", data, 4096 + 1024 * index + 40)[0]
        harmonics = 3 * ((degree + 1) ** 2 - 1)
        size = (44 + 4 * harmonics, 24 + 2 * harmonics, 24 + harmonics)[level]
        lengths = [bucket] * full + list(struct.unpack_from(f"<{partial}I", data, at))
        owners = [place for place, length in enumerate(lengths) for _ in range(length)]
        rows = at + 4 * partial + stride * buckets
        for row in range(count):
            if level == 0:
                means.append(struct.unpack_from("<3f", data, rows + size * row))
                continue
            center = struct.unpack_from("<3f", data, at + 4 * partial + 12 * owners[row])
            numbers = struct.unpack_from("<3H", data, rows + size * row)
            far = steps or 32767
            means.append(
                [(n - far) * (block / 2 / far) + c for n, c in zip(numbers, center, strict=True)]
            )
        at = rows + size * room
    return np.array(means, np.float64).reshape(-1, 3)


def usda_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in the one line of a USDA layer that gives them."""
    declared = rb"^\s*(?:custom )?(?:uniform )?point3f\[\] positions = \[(.*)\]"
    found = re.findall(declared, data, re.MULTILINE)
    if len(found) != 1:
        raise Illegal(f"{len(found)} lines with positions")
    return np.array([float(number) for number in re.findall(rb"[^(), ]+", found[0])]).reshape(-1, 3)
