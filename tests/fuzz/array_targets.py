"""Fuzz targets: arrays, text and SPZ."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz import oracles
from tests.fuzz.cloud_targets import some_gaussians
from tests.fuzz.target import cloud_of, require, require_picture, require_points, strictly
from threestudio_gaussiandreamer.formats.spz import read_spz, spz_bytes
from threestudio_gaussiandreamer.gaussians.gaussians import usable
from threestudio_gaussiandreamer.priors.motion import read_motions
from threestudio_gaussiandreamer.priors.point_cloud import PointCloudPrior


def _saved(save: Callable, *arguments: Any, **named: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *arguments, **named)
    return buffer.getvalue()


MOTION = np.random.default_rng(0).normal(size=(2, 22, 3, 5)).astype(np.float32)
ROWS = np.random.default_rng(1).random((15, 6))


def motion_archives() -> list[bytes]:
    named = {
        "motion": MOTION,
        "text": np.array(["a walk", "ein Sprung ü"]),
        "lengths": np.array([5, 3]),
    }
    return [
        _saved(np.savez, **named),
        _saved(np.savez_compressed, **named),
        _saved(np.save, MOTION),
    ]


def exercise_motions(path: Path) -> None:
    motions = read_motions(str(path))
    samples, frames, joints, three = motions.positions.shape
    require(joints in (22, 24) and three == 3 and len(motions.lengths) == samples, "shapes")
    require(
        all(
            np.isfinite(p[:n]).all() and 0 < n <= frames
            for p, n in zip(motions.positions, motions.lengths, strict=True)
        ),
        "frames",
    )
    if path.read_bytes()[:6] == b"\x93NUMPY":
        require(
            strictly(oracles.npy_array, path).size == motions.positions.size, "numbers are missing"
        )


def point_archives() -> list[bytes]:
    named = {
        "points": ROWS[:, :3],
        "colors": (255 * ROWS[:, 3:]).astype(np.uint8),
        "normals": ROWS[:, :3].astype(np.float32),
    }
    return [_saved(np.savez, **named), _saved(np.savez_compressed, **named)]


def exercise_points(path: Path) -> None:
    require_points(PointCloudPrior({"path": str(path)})("a fox"))


def exercise_npy_points(path: Path) -> None:
    cloud = PointCloudPrior({"path": str(path)})("a fox")
    require_points(cloud)
    rows = strictly(oracles.npy_array, path)
    with np.errstate(over="ignore", invalid="ignore"):
        usable = (
            np.isfinite(rows[:, :3].astype(np.float32)).all(axis=1)
            if rows.dtype.kind in "fiu"
            else np.zeros(0)
        )
    require(len(cloud.points) <= len(usable) <= 1.06 * len(cloud.points) + 1, "rows are missing")


def texts() -> list[bytes]:
    points = b"\n".join(b" ".join(b"%.6f" % value for value in row[:3]) for row in ROWS)
    colored = b"\n".join(b",".join(b"%.6f" % value for value in row) for row in ROWS)
    scan = b"15\n" + b"\n".join(
        b"%.4f %.4f %.4f 12 %d %d %d" % (*row[:3], *(255 * row[3:]).astype(int)) for row in ROWS
    )
    return [points, b"x,y,z,r,g,b\n" + colored, scan]


def spz_files() -> list[bytes]:
    return [
        spz_bytes(some_gaussians(12, 0)),
        spz_bytes(some_gaussians(9, 1), comment="up: y"),
        spz_bytes(some_gaussians(3, 3)),
    ]


def exercise_spz(path: Path) -> None:
    arrays = read_spz(path)
    content = strictly(oracles.gunzipped, path)
    count = int.from_bytes(content[8:12], "little")
    require(len(arrays.means) == count, f"{len(arrays.means)} Gaussians, but the file says {count}")
    require(bool(usable(arrays).all()), "values aren't finite")
    if count:
        require_picture(cloud_of(arrays))
