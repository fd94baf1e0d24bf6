"""PLY files for tests: random content, any header, and values that the writer leaves out."""

from pathlib import Path

import numpy as np

from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud

FLOATS = "float x", "float y", "float z"


def write_raw_gaussians(path: Path, gaussians: Gaussians, comments: tuple[str, ...] = ()) -> None:
    """Write Gaussians as they are, NaN and infinity included."""
    properties = ply.gaussian_properties(gaussians.sh.shape[1])
    ply.write_table(path, properties, ply.gaussian_columns(gaussians), comments)


def rng(seed=0):
    return np.random.default_rng(seed)


def gaussians(count=50, degree=0, seed=0):
    """Draw Gaussians of normally distributed values."""
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3)]
    values = (rng(seed + i).normal(size=shape) for i, shape in enumerate(shapes))
    return Gaussians(*(value.astype(np.float32) for value in values))


def cloud(count=50, normals=True):
    """Draw coloured points, whose normals equal their positions."""
    values = rng(9).normal(size=(count, 3)).astype(np.float32)
    colors = rng(8).random((count, 3), np.float32)
    return PointCloud(points=values, colors=colors, normals=values if normals else None)


def ply_bytes(columns, encoding="ascii", *, count=None, before=("", b""), after=("", b"")):
    """Return a PLY file of vertices, and header and bytes of other elements around them.

    Args:
        columns: type and values of each property, by name.
        count: what the header announces, if not the number of values.
    """
    order = ply.BYTE_ORDERS[encoding] or "<"
    kinds = [(name, order + ply.NUMBER_TYPES[kind]) for name, (kind, _) in columns.items()]
    rows = np.array([*zip(*(values for _, values in columns.values()), strict=True)], kinds)
    lines = (b" ".join(b"%.9g" % value for value in row) + b"\n" for row in rows.tolist())
    body = b"".join(lines) if encoding == "ascii" else rows.tobytes()
    properties = [f"{kind} {name}" for name, (kind, _) in columns.items()]
    counted = len(rows) if count is None else count
    head = header(encoding, counted, properties, before[0], after[0])
    return head.encode() + before[1] + body + after[1]


def header(encoding="ascii", count=2, properties=FLOATS, before="", after=""):
    """Return the header of a PLY file as other programs write it."""
    lines = ["ply", f"format {encoding} 1.0", *filter(None, [before]), f"element vertex {count}"]
    lines += [f"property {entry}" for entry in properties]
    return "\n".join([*lines, *filter(None, [after]), "end_header\n"])


def saved(folder, content, name="file.ply"):
    """Write a file of any content; return its path."""
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode("latin-1"))
    return path
