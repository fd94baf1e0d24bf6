"""Fuzz targets: PLY files of Gaussians and points."""

from pathlib import Path

import numpy as np

from tests.fuzz import oracles
from tests.fuzz.target import (
    cloud_of,
    messages,
    require,
    require_picture,
    require_points,
    same,
    strictly,
)
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.priors.gaussians import GaussiansPrior
from threestudio_gaussiandreamer.priors.point_cloud import PointCloudPrior


def some_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3)]
    arrays = Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    return arrays._replace(log_scales=arrays.log_scales - 2)


def ply_bytes(
    columns: dict[str, tuple[str, np.ndarray]], encoding: str, faces: bool = False
) -> bytes:
    """A PLY of any encoding, with an element of lists before the vertices if asked for."""
    order = ply.BYTE_ORDERS[encoding]
    count = len(next(iter(columns.values()))[1])
    lines = ["ply", f"format {encoding} 1.0", "comment made for fuzzing"]
    lines += (
        ["element face 2", "property list uchar int vertex_indices", "property float area"]
        if faces
        else []
    )
    lines += [
        f"element vertex {count}",
        *(f"property {kind} {name}" for name, (kind, _) in columns.items()),
        "end_header",
    ]
    rows = np.empty(
        count,
        [(name, (order or "<") + ply.NUMBER_TYPES[kind]) for name, (kind, _) in columns.items()],
    )
    for name, (_, values) in columns.items():
        rows[name] = values
    if encoding == "ascii":
        body = b"3 0 1 2 0.5\n4 0 1 2 3 0.25\n" if faces else b""
        body += b"".join(
            b" ".join(b"%.9g" % value for value in row) + b"\n" for row in rows.tolist()
        )
    else:
        face = np.dtype([("n", "u1"), ("v", order + "i4", 3), ("area", order + "f4")])
        body = (
            np.array([(3, [0, 1, 2], 0.5)] * 2, face).tobytes() if faces else b""
        ) + rows.tobytes()
    return ("\n".join(lines) + "\n").encode() + body


def gaussian_plys() -> list[bytes]:
    seeds = []
    for encoding, degree, faces in (
        ("ascii", 0, False),
        ("binary_little_endian", 1, True),
        ("binary_big_endian", 0, False),
    ):
        arrays = some_gaussians(12, degree)
        rest = arrays.sh[:, 1:].transpose(0, 2, 1).reshape(12, -1)
        values = [
            arrays.means,
            arrays.sh[:, 0],
            rest,
            arrays.logit_opacities[:, None],
            arrays.log_scales,
            arrays.quats,
        ]
        names = [
            *ply.MEANS,
            *ply.SH_CONSTANT,
            *(f"f_rest_{i}" for i in range(rest.shape[1])),
            "opacity",
            *ply.LOG_SCALES,
            *ply.QUATS,
        ]
        columns = dict(
            zip(
                names,
                (("float", column) for column in np.concatenate(values, axis=1).T),
                strict=True,
            )
        )
        seeds.append(ply_bytes(columns, encoding, faces))
    return seeds


def point_plys() -> list[bytes]:
    rng = np.random.default_rng(1)
    places = {name: ("float", rng.normal(size=20)) for name in "xyz"}
    bytes_, shorts = (
        {name: (kind, rng.integers(0, 255, 20)) for name in ("red", "green", "blue")}
        for kind in ("uchar", "ushort")
    )
    floats = {name: ("double", rng.random(20)) for name in ("red", "green", "blue")}
    normals = {name: ("float", np.full(20, 0.577)) for name in ("nx", "ny", "nz")}
    seeds = [
        ply_bytes(places | bytes_, "ascii"),
        ply_bytes(places | normals | bytes_, "binary_little_endian", faces=True),
    ]
    return [
        *seeds,
        ply_bytes(places | shorts, "binary_big_endian"),
        ply_bytes(places | floats, "ascii", faces=True),
    ]


def exercise_gaussians_ply(path: Path) -> None:
    with messages() as said:
        arrays = ply.read_gaussians(path, allow_non_finite=True)
    truth = strictly(oracles.ply_vertices, path)
    require(not truth.leftover or bool(said), "data after the announced end without a message")
    columns = truth.columns
    rest = [
        columns[f"f_rest_{i}"] for i in range(sum(name.startswith("f_rest_") for name in columns))
    ]
    sh = np.stack([columns[name] for name in ply.SH_CONSTANT], 1)[:, None]
    if rest:
        sh = np.concatenate(
            [sh, np.stack(rest, 1).reshape(truth.count, 3, -1).transpose(0, 2, 1)], 1
        )
    for values, names in (
        (arrays.means, ply.MEANS),
        (arrays.log_scales, ply.LOG_SCALES),
        (arrays.quats, ply.QUATS),
    ):
        same(values, np.stack([columns[name] for name in names], 1), names[0])
    same(arrays.logit_opacities, columns["opacity"], "opacities")
    same(arrays.sh, sh, "harmonics")
    prior = GaussiansPrior({"path": str(path)})
    require_points(prior("a fox"))
    require_picture(cloud_of(prior.gaussians("a fox")))


def exercise_points_ply(path: Path) -> None:
    with messages() as said:
        cloud = ply.read_points(path, allow_non_finite=True)
    truth = strictly(oracles.ply_vertices, path)
    require(not truth.leftover or bool(said), "data after the announced end without a message")
    same(cloud.points, np.stack([truth.columns[name] for name in "xyz"], 1), "points")
    if (
        truth.types.get("red") == "B"
        and {"green", "blue"} <= set(truth.columns)
        and "float_red" not in truth.columns
    ):
        colors = np.stack([truth.columns[name] for name in ("red", "green", "blue")], 1)
        require(
            bool(np.allclose(cloud.colors, colors / 255, atol=1e-6, equal_nan=True)),
            "colours aren't what the file says",
        )
    require_points(PointCloudPrior({"path": str(path)})("a fox"))
