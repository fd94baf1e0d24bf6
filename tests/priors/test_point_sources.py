"""The point-cloud and Gaussians priors; files in the conventions of other generators become priors
that stand upright, face +x, have the size of ``scale`` and display colours.
"""

import logging

import numpy as np
import pytest
import trimesh

from tests.formats.test_producers import EXPORTS
from tests.helpers.ply_files import write_raw_gaussians
from tests.priors.cases import build, rng
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.formats.producers import GAUSSIANS
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import C0
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.priors.base import preflight_prior

register_parts()
POINTS = np.array([[0, 0, 0], [1, 2, 4], [2, 0, 1]], np.float32)
BYTES = np.array([[255, 0, 51], [0, 0, 0], [0, 102, 255]])


def test_gaussians_give_centres_colours_and_all_attributes(assets):
    stored, prior = ply.read_gaussians(assets / "gaussians.ply"), build("gaussians-prior", assets)
    cloud, colors = prior(""), 0.5 + 0.28209479 * stored.sh[:, 0]
    np.testing.assert_array_equal(cloud.points, stored.means)
    np.testing.assert_allclose(cloud.colors, colors.clip(0, 1), atol=1e-6)
    for a, b in zip(prior.gaussians(""), stored, strict=True):
        np.testing.assert_array_equal(a, b)
    kept = build("gaussians-prior", assets, min_opacity=0.5).gaussians("")
    np.testing.assert_array_equal(kept.means, stored.means[stored.logit_opacities >= 0])
    with pytest.raises(UserError, match="no Gaussians.*opacity of 1.0 or more, among 200"):
        build("gaussians-prior", assets, min_opacity=1.0)("")
    grounded = build("gaussians-prior", assets, ground=True)
    preflight_prior(grounded, keep_attributes=False)
    with pytest.raises(UserError, match="ground"):
        preflight_prior(grounded, keep_attributes=True)
    as_points = build("point-cloud-prior", assets, path="gaussians.ply")("").points
    np.testing.assert_array_equal(as_points, stored.means)


def test_few_bad_gaussians_are_dropped(assets, tmp_path, caplog):
    arrays = ply.read_gaussians(assets / "gaussians.ply")
    arrays.log_scales[3] = np.nan
    write_raw_gaussians(tmp_path / "cloud", arrays)  # a PLY may have any name
    with caplog.at_level(logging.WARNING):
        assert len(find("gaussians-prior")({"path": str(tmp_path / "cloud")})("").points) == 199
    assert "dropped 1 of 200" in caplog.text
    arrays.quats[:20] = np.inf
    write_raw_gaussians(tmp_path / "a.ply", arrays)
    with pytest.raises(UserError, match="20 of the 200"):
        find("gaussians-prior")({"path": str(tmp_path / "a.ply")})("")


@pytest.mark.parametrize(
    "name, problem",
    [
        ("points.ply", "plain points"),
        ("tri.obj", r"tri.obj': .obj isn't one of the formats that are read: .ply.*\.splat$"),
        ("cloud", "cloud': a name without extension isn't one of the formats"),
        ("last.ckpt", r".ckpt isn't.*; export a checkpoint first.*last.ckpt"),
    ],
)
def test_the_wrong_kind_of_file_is_named(assets, tmp_path, name, problem):
    content = (assets / name).read_bytes() if name == "points.ply" else b"v 0 0 0"
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=problem):
        find("gaussians-prior")({"path": str(tmp_path / name)}).preflight()


# Points -------------------------------------------------------------------------------------------


def read(path, **options):
    return find("point-cloud-prior")({"path": str(path), **options})("")


def written(path, colors=BYTES, as_bytes=True):
    """Write the three points with colours; as bytes or floats where the format has types."""
    rows = np.concatenate([POINTS, colors], axis=1)
    if path.suffix == ".npz":
        np.savez(path, points=POINTS, colors=colors.astype(np.uint8) if as_bytes else colors)
    elif path.suffix == ".npy":
        np.save(path, np.concatenate([POINTS, colors / 255], axis=1))
    elif path.suffix == ".csv":
        np.savetxt(path, rows, delimiter=", ", header="x,y,z,r,g,b", comments="")
    elif path.suffix == ".pts":
        np.savetxt(path, np.insert(rows, 3, 7.0, axis=1), header="3", comments="")
    elif path.suffix in (".xyz", ".txt"):
        np.savetxt(path, rows)
    elif as_bytes:
        rgba = np.insert(colors, 3, 255, axis=1).astype(np.uint8)
        trimesh.PointCloud(POINTS, colors=rgba).export(path)
    else:
        properties = [(name, "float") for name in (*ply.MEANS, *ply.COLORS)]
        ply.write_table(path, properties, rows.astype(np.float32))
    return path


def test_formats_axes_and_scale(assets, tmp_path):
    for suffix in ("npz", "npy", "xyz", "txt", "csv", "pts", "ply"):
        cloud = read(written(tmp_path / f"a.{suffix}"))
        np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)
        np.testing.assert_allclose(cloud.colors, BYTES / 255, atol=1e-6)
    cloud = read(written(tmp_path / "a.glb"))  # y up, z to the front
    np.testing.assert_allclose(cloud.points, POINTS[:, [2, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(cloud.colors, BYTES / 255, atol=1e-6)
    turned = read(tmp_path / "a.xyz", up="+y", front="+z").points
    np.testing.assert_allclose(turned, POINTS[:, [2, 0, 1]], atol=1e-6)
    with pytest.raises(UserError, match="up axis"):
        read(tmp_path / "a.xyz", up="y")
    scaled = read(tmp_path / "a.xyz", normalize=True, scale=0.5).points
    np.testing.assert_allclose(scaled, (POINTS - [1, 1, 2]) / 4, atol=1e-6)
    mesh = trimesh.load(assets / "box.ply", process=False)
    mesh.export(tmp_path / "box.off")
    np.testing.assert_allclose(read(tmp_path / "box.off").points, mesh.vertices, atol=1e-6)


@pytest.mark.parametrize("name", ["a.npz", "a.xyz", "a.ply"])
def test_ranges_of_colours(tmp_path, name):
    for full in (255, 65535):
        colors = read(written(tmp_path / name, BYTES * (full // 255), False)).colors
        np.testing.assert_allclose(colors, BYTES / 255, atol=1e-6)
    slightly = np.array([[-0.005, 0.5, 1.9], [0, 0, 0], [1, 1, 1]])
    found = read(written(tmp_path / name, slightly, False)).colors
    np.testing.assert_allclose(found, slightly.clip(0, 1), atol=1e-6)
    for low, high in [(0, 70000), (0, 300.5), (-100, 100), (-0.5, 1), (-3000, 3000)]:
        colors = np.array([[low, 0, 0], [0, high, 0], [0, 0, 1]], float)
        with pytest.raises(UserError, match=rf"{name}.* from {low:g} to {high:g}; integers"):
            read(written(tmp_path / name, colors, False))


def test_few_bad_rows_are_dropped_also_when_normalized(tmp_path):
    points = rng().uniform(-1, 1, (100, 3))
    points[7] = np.nan
    np.savez(tmp_path / "a.npz", points=points)
    cloud = read(tmp_path / "a.npz", normalize=True)
    assert len(cloud.points) == 99 and np.ptp(cloud.points, axis=0).max() == pytest.approx(2)
    assert (cloud.colors == 0.5).all()


PLY = b"ply\nformat ascii 1.0\nelement vertex 1\n"
PLY += b"".join(b"property float %c\n" % axis for axis in b"xyz") + b"end_header\n"


@pytest.mark.parametrize(
    "name, content, problem",
    [
        ("a.xyz", b"1 2\n3 4\n", "rows of x y z"),
        ("a.xyz", b"1 2 3\n4 5 fox\n", "truncated, damaged or of another format"),
        ("a.npz", b"PK\3\4 broken", "truncated, damaged"),
        ("a.glb", b"glTF broken", "it is truncated or damaged"),
        ("a.ply", b"plyx", "not a PLY"),
        ("a.ply", PLY + b"nan nan nan\n", "PointCloudPrior"),
        ("a.ply", PLY + b"a b c\n", "a.ply"),
        ("a.ply", PLY.replace(b" 1\n", b" 9999999999\n"), "a.ply"),
        ("a.npz", {"xyz": POINTS}, "has no array"),
        ("a.npz", {"points": POINTS, "colors": BYTES[:2]}, "has shape"),
        ("a.npz", {"points": np.array([{}], object)}, "could run code"),
    ],
)
def test_bad_files(tmp_path, name, content, problem):
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    else:
        np.savez(tmp_path / name, **content)
    with pytest.raises(UserError) as error:
        read(tmp_path / name)
    assert problem in str(error.value)


# Producers ----------------------------------------------------------------------------------------

SIZE, SCALE = 0.37, 1.25


def frame(axes):
    """Return the rotation from (front, left, up), the world's axes, to axes with this up and
    front.
    """
    up, front = np.array(axes, float)
    return np.stack([front, np.cross(up, front), up], axis=1)


def box():
    """Return a box without symmetry: longest upwards, with a colour for each corner."""
    mesh = trimesh.creation.box(extents=[0.5, 0.8, 2.0])
    mesh.vertices[mesh.vertices[:, 2] > 0] *= [0.6, 0.5, 1.0]
    mesh.vertices[mesh.vertices[:, 0] > 0] += [0.1, 0.05, 0.0]
    colors = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 3), np.uint8)
    return mesh, colors


def write_gaussians(path, vertices, colors):
    count = len(vertices)
    cloud = Gaussians(
        means=np.float32(vertices),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), np.log(0.01), np.float32),
        logit_opacities=np.full(count, 3, np.float32),
        sh=np.float32((colors[:, None] / 255 - 0.5) / C0),
    )
    ply.write_gaussians(path, cloud, [])


CASES = [
    (name, kind, suffix, axes, export)
    for name, kind, axes, export in EXPORTS
    for suffix in ((".ply",) if kind == GAUSSIANS else (".glb", ".obj", ".ply"))
]


@pytest.mark.parametrize(("name", "kind", "suffix", "axes", "export"), CASES)
def test_a_file_comes_in_upright_to_the_front_scaled_and_in_display_colours(
    name, kind, suffix, axes, export, tmp_path
):
    mesh, colors = box()
    turn = export @ frame(axes) @ np.diag([1, np.linalg.det(export), 1])  # one renderer mirrors
    vertices = SIZE * mesh.vertices @ turn.T + [0.3, -0.2, 0.1]
    path = tmp_path / f"object{suffix}"
    if kind == GAUSSIANS:
        write_gaussians(path, vertices, colors)
    else:
        trimesh.Trimesh(vertices, mesh.faces, vertex_colors=colors, process=False).export(path)
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    wanted = SCALE * (mesh.vertices - middle) / (np.ptp(mesh.vertices, axis=0).max() / 2)
    for part in ("gaussians-prior" if kind == GAUSSIANS else "mesh-prior", "point-cloud-prior"):
        cloud = find(part)({"path": str(path), "producer": name, "scale": SCALE})("")
        # colours are all different, and tell which point is which
        order = [np.abs(cloud.colors - color).sum(axis=1).argmin() for color in colors / 255]
        points, found = cloud.points[order], cloud.colors[order]
        np.testing.assert_allclose(points, wanted, atol=1e-4)
        np.testing.assert_allclose(found, colors / 255, atol=1 / 254)


def test_all_attributes_of_gaussians_are_scaled(tmp_path):
    mesh, colors = box()
    write_gaussians(tmp_path / "a.ply", SIZE * mesh.vertices, colors)
    options = {"path": str(tmp_path / "a.ply"), "producer": "lgm", "scale": SCALE}
    cloud = find("gaussians-prior")(options).gaussians("")
    np.testing.assert_allclose(np.exp(cloud.log_scales), 0.01 * SCALE / SIZE, rtol=1e-5)
    still = find("gaussians-prior")(options | {"normalize": False}).gaussians("")
    np.testing.assert_allclose(np.exp(still.log_scales), 0.01, rtol=1e-6)
    assert np.ptp(still.means, axis=0).max() == pytest.approx(2 * SIZE, rel=1e-5)


BOTH = "give it, or up and front"
UNUSED = "scale has no effect without normalize or producer: leave"


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("mesh-prior", {"producer": "trelis"}, "did you mean 'trellis'"),
        ("gaussians-prior", {"producer": "lgm", "up": "y"}, BOTH),
        ("mesh-prior", {"producer": "trellis", "up": "+y"}, BOTH),
        ("point-cloud-prior", {"producer": "trellis", "front": "+y"}, BOTH),
        ("gaussians-prior", {"scale": SCALE}, UNUSED),
        ("mesh-prior", {"producer": "diffsplat"}, "files of Gaussians.*producers of meshes are"),
        ("gaussians-prior", {"producer": "triposr"}, "stands for files of meshes"),
    ],
)
def test_wrong_combinations_are_refused_when_the_prior_is_built(name, options, problem):
    with pytest.raises(UserError, match=problem):
        find(name)({"path": "a.glb"} | options)
    if problem == UNUSED:
        find(name)({"path": "a.glb", "normalize": False} | options)


def test_a_producer_of_other_files_is_refused_by_the_file(tmp_path):
    box()[0].export(tmp_path / "a.glb")
    prior = find("point-cloud-prior")({"path": str(tmp_path / "a.glb"), "producer": "diffsplat"})
    with pytest.raises(UserError, match="stands for files of Gaussians"):
        prior("")
