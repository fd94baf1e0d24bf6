"""The ray caster sees what the cameras say, by Embree and by the z-buffer."""

import logging
import math
import sys
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh

from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.meshes import raycast
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import Mesh

SIDES = {"+x": (0, 0), "+y": (0, 90), "-x": (0, 180), "-y": (0, -90), "+z": (89.9, 0)}
SIDES["-z"] = (-89.9, 0)
COLORS = {"+x": (1, 0, 0), "-x": (0, 1, 1), "+y": (0, 1, 0), "-y": (1, 0, 1), "+z": (0, 0, 1)}
COLORS["-z"] = (1, 1, 0)


@pytest.fixture(params=["embree", "zbuffer"])
def caster_name(request, monkeypatch):
    if request.param == "zbuffer":  # importing it is an ImportError now
        monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    else:
        pytest.importorskip("embreex")
    return request.param


both = pytest.mark.usefixtures("caster_name")


def look(elevation, azimuth, distance):
    values = (elevation, azimuth, distance)
    angles = (torch.tensor([float(value)], dtype=torch.float64) for value in values)
    return cameras.orbit_c2w(*angles)[0].numpy()


def cube(size=1.0):
    source = trimesh.creation.box((size, size, size))
    sides = source.face_normals.round().astype(int)
    names = ["+-"[int(side.sum() < 0)] + "xyz"[int(np.abs(side).argmax())] for side in sides]
    colors = np.array([COLORS[name] for name in names], dtype=np.float32)
    return Mesh(np.array(source.vertices), np.array(source.faces), face_colors=colors)


def sphere(radius=1.0, subdivisions=5):
    source = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(np.array(source.vertices), np.array(source.faces))


def picture(caster, c2w, fovy, height, width, supersample=2):
    return caster.render_views([(c2w, fovy)], height, width, supersample=supersample)[0]


@both
def test_the_silhouette_of_a_sphere(distance=3.0, fovy=40.0, height=80, width=120):
    """Radius r at distance d subtends the angle asin(r / d): a disc of radius f tan of it."""
    view = look(20, 30, distance), math.radians(fovy)
    image = picture(raycast.MeshCaster(sphere(0.8)), *view, height, width, supersample=4)
    focal = height / (2 * math.tan(math.radians(fovy) / 2))
    radius = focal * math.tan(math.asin(0.8 / distance))
    # the icosphere's edges lie 5e-4 inside; 16 samples a pixel leave about 0.2 % of the area
    np.testing.assert_allclose(image[..., 3].sum(), math.pi * radius**2, rtol=5e-3)
    rows, columns = np.nonzero(image[..., 3] > 0.5)
    assert abs(rows.mean() + 0.5 - height / 2) < 0.1 and abs(columns.mean() + 0.5 - width / 2) < 0.1
    for span in (np.ptp(rows), np.ptp(columns)):
        assert abs(span + 1 - 2 * radius) < 1.5


@both
def test_a_cube_is_seen_upright_not_mirrored_and_from_inside():
    """From the front, +y is on the right and +z on top."""
    caster = raycast.MeshCaster(cube())
    for side, angles in SIDES.items():
        image = picture(caster, look(*angles, 3), math.radians(40), 32, 32)
        np.testing.assert_allclose(image[16, 16], [*COLORS[side], 1], atol=1e-6)
    image = picture(caster, look(30, 30, 3), math.radians(40), 64, 64)
    red, green, blue = image[..., 0] > 0.1, image[..., 1] > 0.9, image[..., 2] > 0.9
    assert np.nonzero(green & ~red & (image[..., 2] < 0.1))[1].mean() > 36  # +y
    assert np.nonzero(blue & ~red)[0].mean() < 24  # +z
    caster = raycast.MeshCaster(cube())
    inside, away = look(10, 20, 0.1), look(10, 20, 3)
    away[:3, :3] *= [-1, 1, -1]  # looks the other way
    assert picture(caster, inside, 1.0, 8, 8)[..., 3].min() == 1
    assert picture(caster, away, 1.0, 8, 8).max() == 0
    beside = look(0, 0, 3)
    beside[1, 3] += 50
    assert picture(caster, beside, 1.0, 8, 8).max() == 0


@both
def test_a_point_lands_where_the_intrinsics_say():
    position = np.array([0.3, -0.2, 0.4])
    mesh = sphere(0.02, 2)
    mesh = mesh._replace(vertices=mesh.vertices + position)
    c2w, fovy, height, width = look(25, 70, 2.5), math.radians(50), 60, 100
    image = picture(raycast.MeshCaster(mesh), c2w, fovy, height, width, supersample=8)
    viewmats, Ks = cameras.to_opencv(torch.tensor(c2w)[None], torch.tensor([fovy]), height, width)
    projected = Ks[0].double() @ (viewmats[0, :3, :3] @ torch.tensor(position) + viewmats[0, :3, 3])
    weights = image[..., 3] / image[..., 3].sum()
    columns, rows = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    center = [(weights * columns).sum(), (weights * rows).sum()]  # the disc is 2 pixels wide
    np.testing.assert_allclose(center, (projected[:2] / projected[2]).numpy(), atol=0.05)


@both
def test_colour_is_premultiplied_and_supersampling_is_the_mean_of_a_larger_picture(monkeypatch):
    caster = raycast.MeshCaster(cube())
    image = picture(caster, look(0, 0, 3), math.radians(40), 30, 30, supersample=4)
    edge = (image[..., 3] > 0) & (image[..., 3] < 1)
    assert edge.any()
    np.testing.assert_allclose(image[..., 0], image[..., 3], atol=1e-6)  # the front is red
    over = raycast.over_background(image, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(over[..., :2].sum(axis=-1), 1, atol=1e-6)
    view = look(30, 40, 2.5), math.radians(50)
    large = picture(caster, *view, 48, 72, 1).reshape(16, 3, 24, 3, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(picture(caster, *view, 16, 24, 3), large, atol=1e-6)
    monkeypatch.setattr(raycast, "RAYS_PER_CAST", 1)
    np.testing.assert_allclose(picture(caster, *view, 16, 24, 3), large, atol=1e-6)


@pytest.mark.parametrize("terminal", [True, False])
def test_many_views_are_the_single_views(terminal, capfd, monkeypatch):
    """With a progress bar in terminals, where it has a name."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    caster = raycast.MeshCaster(cube())
    views = [(look(10 * i, 40 * i, 2 + 0.1 * i), 0.8) for i in range(6)]
    capfd.readouterr()
    together = caster.render_views(views, 12, 18, supersample=2)
    assert not capfd.readouterr().err
    for image, view in zip(together, views, strict=True):
        np.testing.assert_array_equal(image, picture(caster, *view, 12, 18, 2))
    assert caster.render_views([], 12, 18).shape == (0, 12, 18, 4)
    caster.render_views(views[:2], 4, 4, progress="bank of views")
    assert ("bank of views" in capfd.readouterr().err) == terminal


def orbit_tensors(*azimuths):
    azimuth = torch.tensor([float(a) for a in azimuths])
    distance = torch.full_like(azimuth, 3)
    c2w = cameras.orbit_c2w(torch.zeros_like(azimuth), azimuth, distance)
    return c2w, torch.full_like(azimuth, 0.7)


def test_the_cache_casts_each_picture_once_and_drops_the_oldest_use(recorded):
    caster = raycast.MeshCaster(cube())
    cache, cast = raycast.TargetCache(caster, 2, capacity=3), recorded(caster, "render_views")
    c2w, fovy = orbit_tensors(0, 90, 0)
    first = cache(c2w, fovy, 10, 12)
    assert [len(views) for (views, *_), _ in cast] == [2]
    expected = picture(caster, c2w[1].numpy(), float(fovy[1]), 10, 12, 2)
    np.testing.assert_allclose(first[1] / 255.0, expected, atol=0.5 / 255 + 1e-6)
    cast.clear()
    assert first.dtype == torch.uint8 and torch.equal(cache(c2w, fovy, 10, 12), first) and not cast
    for azimuth in (0, 10, 20, 0, 30):
        cache(*orbit_tensors(azimuth), 4, 4)
    cast.clear()
    cache(*orbit_tensors(20, 0, 30), 4, 4)
    assert not cast
    cache(*orbit_tensors(10), 4, 4)
    assert [len(views) for (views, *_), _ in cast] == [1]
    larger = cache(*orbit_tensors(1, 2, 3, 4, 5), 4, 4)  # a batch larger than the cache
    assert larger.shape == (5, 4, 4, 4)


def test_a_missing_embree_is_reported_once(caster_name, caplog):
    raycast._report_slow_caster.cache_clear()
    with caplog.at_level(logging.WARNING, logger=raycast.__name__):
        raycast.MeshCaster(cube())
        raycast.MeshCaster(cube())
    assert caplog.text.count("pip install embreex") == (caster_name == "zbuffer")


FOCAL = 20.0
PLACES = np.arange(-16, 16) + 0.5


def draw(vertices, faces, rows=PLACES, columns=PLACES):
    """Return the hits of a camera at the origin along -z."""
    mesh = np.array(vertices, dtype=float), np.array(faces)
    return raycast.zbuffer_hits(*mesh, np.eye(4), FOCAL, rows, columns)


def cast(vertices, faces):
    """Intersect every ray with every triangle (Moeller and Trumbore 1997), in float64."""
    y, x = np.meshgrid(-PLACES / FOCAL, PLACES / FOCAL, indexing="ij")
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)[:, :, None]
    a, b, c = np.moveaxis(np.array(vertices, dtype=float)[np.array(faces)], 1, 0)
    p = np.cross(rays, c - a)
    det = np.einsum("hwfc,fc->hwf", p, b - a)
    u = np.einsum("hwfc,fc->hwf", p, -a) / det
    q = np.cross(-a, b - a)
    v = np.einsum("hwfc,fc->hwf", np.broadcast_to(rays, p.shape), q) / det
    t = np.einsum("fc,fc->f", c - a, q) / det
    depth = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    nearest, weights = depth.argmin(axis=-1), np.stack([1 - u - v, u, v], axis=-1)
    weights = np.take_along_axis(weights, nearest[..., None, None], axis=2)[:, :, 0]
    hit = np.isfinite(depth.min(axis=-1))
    return np.where(hit, nearest, -1), np.where(hit[..., None], weights, 0)


def soup(seed, count=150):
    """Return random triangles on all sides of the camera, small and large; many cross its plane."""
    rng = np.random.default_rng(seed)
    corners = 2 * rng.normal(size=(count, 1, 3))
    corners = corners + rng.normal(size=(count, 3, 3)) * rng.uniform(0.1, 0.6, (count, 1, 1))
    return corners.reshape(-1, 3), np.arange(count * 3).reshape(count, 3)


@pytest.mark.parametrize("seed", range(3))
def test_triangles_through_the_camera_plane_are_what_single_rays_see(seed, monkeypatch):
    vertices, faces = soup(seed)
    depth = vertices[faces][..., 2]
    assert ((depth.min(axis=1) < 0) & (depth.max(axis=1) > 0)).sum() > 10
    monkeypatch.setattr(raycast, "_pairs", Mock(wraps=raycast._pairs))
    found, expected = draw(vertices, faces), cast(vertices, faces)
    first, end, left, right = raycast._pairs.call_args[0][0].T
    assert ((end - first) * (right - left)).mean() < 0.4 * len(PLACES) ** 2  # clipped
    assert len(np.unique(found[0])) > 8
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1], atol=1e-9)  # of a few units, in float64


def test_what_is_too_near_behind_on_edge_or_degenerate_is_not_seen():
    """One corner of the triangle is before that plane; the rest of it is visible."""
    vertices = np.array([[-1.0, -1, -1], [1, -1, -1], [0, 1, -1]])
    vertices *= np.array([[0.5], [2], [2]]) * raycast.NEAR
    nearest, weights = cast(vertices, [[0, 1, 2]])
    seen = (nearest >= 0) & (-(weights @ vertices)[..., 2] > raycast.NEAR)
    assert 0 < seen.sum() < (nearest >= 0).sum()
    np.testing.assert_array_equal(draw(vertices, [[0, 1, 2]])[0], np.where(seen, 0, -1))
    behind, on_edge = [[-9, -9, 1], [9, -9, 1], [0, 9, 1]], [[0, 0, -1], [0, 0, -5], [0, 9, -2]]
    line, point = [[-1, -1, -2], [0, 0, -2], [1, 1, -2]], [[0, 0, -2]] * 3
    for triangle in (behind, on_edge, line, point):
        assert (draw(triangle, [[0, 1, 2]])[0] == -1).all()
    face_index, weights = draw(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert (face_index == -1).all() and not weights.any()
    assert draw(behind, [[0, 1, 2]], columns=PLACES[:0])[0].shape == (32, 0)


def test_both_sides_are_seen_the_nearer_one_wins_and_neighbours_leave_no_gap():
    near, far = [[-9, -9, -2], [9, -9, -2], [0, 9, -2]], [[-9, -9, -3], [9, -9, -3], [0, 9, -3]]
    for faces in ([[0, 1, 2], [3, 4, 5]], [[2, 1, 0], [5, 4, 3]]):
        assert draw(near + far, faces)[0][16, 16] == 0
        assert draw(far + near, faces)[0][16, 16] == 1
    assert draw(near + near, [[0, 1, 2], [3, 4, 5]])[0][16, 16] == 0  # of equals the first
    around = ((8, 0), (8, 8), (0, 8), (-8, 8), (-8, 0), (-8, -8), (0, -8), (8, -8))
    ring = [[x, y, -FOCAL / 2] for x, y in around]
    faces = [[0, 1 + i, 1 + (i + 1) % 8] for i in range(8)]
    places = np.arange(-15.5, 16, 0.5)
    face_index, weights = draw([[0, 0, -FOCAL / 2], *ring], faces, rows=places, columns=places)
    assert (face_index >= 0).all()
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=1e-12)


def test_the_toy_has_the_faces_that_embree_finds():
    pytest.importorskip("embreex")
    toy, places = load_mesh("toy.glb"), (np.arange(192) + 0.5) / 2 - 48
    for view, degrees in (((20, 30, 2.5), 50), ((60, -75, 4.0), 40), ((5, 100, 0.6), 90)):
        camera = look(*view), 48 / math.tan(math.radians(degrees) / 2), places, places
        expected, _ = raycast._fastest_hits(toy)(*camera)
        found, _ = raycast.zbuffer_hits(toy.vertices, toy.faces, *camera)
        covered = (found >= 0) | (expected >= 0)
        assert (found == expected)[covered].mean() > 0.995  # ties on edges; Embree's are float32
