import math

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.meshes import raycast
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import Mesh
from threestudio_gaussiandreamer.meshes.raycast import ZBuffer

FOCAL = 20.0
PLACES = np.arange(-16, 16) + 0.5


def look(elevation, azimuth, distance):
    angles = (
        torch.tensor([float(value)], dtype=torch.float64)
        for value in (elevation, azimuth, distance)
    )
    return cameras.orbit_c2w(*angles)[0].numpy()


def draw(vertices, faces, c2w=None, rows=PLACES, columns=PLACES):
    """Return the hits of a camera, by default at the origin along -z."""
    return ZBuffer(np.array(vertices, dtype=float), np.array(faces)).hits(
        np.eye(4) if c2w is None else c2w, FOCAL, rows, columns
    )


def cast(vertices, faces, rows=PLACES, columns=PLACES):
    """Return the nearest face of each sample by intersecting every ray with every triangle (Moeller
    and Trumbore 1997), in float64.
    """
    y, x = np.meshgrid(-rows / FOCAL, columns / FOCAL, indexing="ij")
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)[:, :, None]
    a, b, c = np.moveaxis(np.array(vertices, dtype=float)[np.array(faces)], 1, 0)
    p = np.cross(rays, c - a)
    det = np.einsum("hwfc,fc->hwf", p, b - a)
    u = np.einsum("hwfc,fc->hwf", p, -a) / det
    q = np.cross(-a, b - a)
    v = np.einsum("hwfc,fc->hwf", np.broadcast_to(rays, p.shape), q) / det
    t = np.einsum("fc,fc->f", c - a, q) / det
    depth = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    nearest = depth.argmin(axis=-1)
    weights = np.take_along_axis(
        np.stack([1 - u - v, u, v], axis=-1), nearest[..., None, None], axis=2
    )[:, :, 0]
    hit = np.isfinite(depth.min(axis=-1))
    return np.where(hit, nearest, -1), np.where(hit[..., None], weights, 0)


def soup(seed, count=150):
    """Return random triangles on all sides of the camera, small and large; many cross its plane."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 1, 3)) * 2 + rng.normal(size=(count, 3, 3)) * rng.uniform(
        0.1, 0.6, (count, 1, 1)
    )
    return corners.reshape(-1, 3), np.arange(count * 3).reshape(count, 3)


def assert_same(found, expected):
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(
        found[1], expected[1], atol=1e-9
    )  # both are float64; the triangles are a few units large


@pytest.mark.parametrize("seed", range(5))
def test_triangles_through_the_camera_plane_are_what_single_rays_see(seed):
    vertices, faces = soup(seed)
    depth = vertices[faces][..., 2]
    assert ((depth.min(axis=1) < 0) & (depth.max(axis=1) > 0)).sum() > 10
    found = draw(vertices, faces)
    assert len(np.unique(found[0])) > 8
    assert_same(found, cast(vertices, faces))


def test_working_in_small_steps_changes_nothing(monkeypatch):
    vertices, faces = soup(7)
    whole = draw(vertices, faces)
    monkeypatch.setattr(raycast, "PAIRS_PER_STEP", 37)
    assert_same(draw(vertices, faces), whole)
    assert_same(draw(vertices, np.concatenate([faces, faces])), whole)  # of equals the first stays


def test_a_moved_camera_sees_what_a_moved_mesh_shows():
    vertices, faces = soup(3)
    c2w = look(25, 70, 1.5)
    assert_same(draw(vertices, faces, c2w), cast((vertices - c2w[:3, 3]) @ c2w[:3, :3], faces))


def test_a_floor_below_the_camera_reaches_the_horizon_in_perspective():
    """A huge floor at height -1 under a level camera covers all samples below the horizon, and the
    weights reproduce the world positions.
    """
    vertices = np.array([[-1e3, -1, 1e3], [1e3, -1, 1e3], [0, -1, -1e6]])
    face_index, weights = draw(vertices, [[0, 1, 2]], columns=PLACES / 20)
    np.testing.assert_array_equal(
        face_index, np.where(PLACES[:, None] > 0, 0, -1) * np.ones(32, int)
    )
    places = (weights @ vertices)[16:]
    depth = FOCAL / PLACES[16:, None]
    np.testing.assert_allclose(
        places[..., 2], -depth + np.zeros(32), rtol=1e-6
    )  # weights of 1e-9 times 1e6 units
    np.testing.assert_allclose(places[..., 0], depth * PLACES / 20 / FOCAL, atol=1e-6)


def test_what_is_nearer_than_the_near_plane_is_not_seen():
    """One corner of the triangle is before that plane; the rest of it is visible."""
    vertices = (
        np.array([[-1.0, -1, -1], [1, -1, -1], [0, 1, -1]])
        * np.array([[0.5], [2], [2]])
        * raycast.NEAR
    )
    nearest, weights = cast(vertices, [[0, 1, 2]])
    seen = (nearest >= 0) & (-(weights @ vertices)[..., 2] > raycast.NEAR)
    assert 0 < seen.sum() < (nearest >= 0).sum()
    np.testing.assert_array_equal(draw(vertices, [[0, 1, 2]])[0], np.where(seen, 0, -1))


def test_behind_on_edge_and_degenerate_triangles_are_not_seen():
    behind, on_edge = [[-9, -9, 1], [9, -9, 1], [0, 9, 1]], [[0, 0, -1], [0, 0, -5], [0, 9, -2]]
    line, point = [[-1, -1, -2], [0, 0, -2], [1, 1, -2]], [[0, 0, -2]] * 3
    for triangle in (behind, on_edge, line, point):
        assert (draw(triangle, [[0, 1, 2]])[0] == -1).all()
    face_index, weights = draw(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert (face_index == -1).all() and not weights.any()
    assert draw(behind, [[0, 1, 2]], columns=PLACES[:0])[0].shape == (32, 0)


def test_both_sides_are_seen_and_the_nearer_one_wins():
    near, far = [[-9, -9, -2], [9, -9, -2], [0, 9, -2]], [[-9, -9, -3], [9, -9, -3], [0, 9, -3]]
    for faces in ([[0, 1, 2], [3, 4, 5]], [[2, 1, 0], [5, 4, 3]]):
        assert draw(near + far, faces)[0][16, 16] == 0
        assert draw(far + near, faces)[0][16, 16] == 1
    assert draw(near + near, [[0, 1, 2], [3, 4, 5]])[0][16, 16] == 0  # of equals the first


def test_neighbours_leave_no_gap_on_samples_of_their_edges():
    """A fan whose edges pass exactly through samples: its inside is covered completely."""
    ring = [
        [x, y, -FOCAL / 2]
        for x, y in ((8, 0), (8, 8), (0, 8), (-8, 8), (-8, 0), (-8, -8), (0, -8), (8, -8))
    ]
    faces = [[0, 1 + i, 1 + (i + 1) % 8] for i in range(8)]
    places = np.arange(-15.5, 16, 0.5)
    face_index, weights = draw([[0, 0, -FOCAL / 2], *ring], faces, rows=places, columns=places)
    assert (face_index >= 0).all()
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=1e-12)


# Against Embree, on the bundled toy


@pytest.fixture(scope="module")
def toy():
    pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    return load_mesh("toy.glb")


VIEWS = [
    (look(20, 30, 2.5), 50.0),
    (look(-10, 200, 1.5), 70.0),
    (look(60, -75, 4.0), 40.0),
    (look(5, 100, 0.6), 90.0),
]


@pytest.mark.parametrize("view", range(len(VIEWS)))
def test_the_toy_equals_embrees_render(toy, view, monkeypatch):
    c2w, degrees = VIEWS[view]
    caster = raycast.MeshCaster(toy)
    expected = caster.render(c2w, math.radians(degrees), 96, 96, supersample=2)
    monkeypatch.setattr(caster, "_hits", ZBuffer(toy.vertices, toy.faces).hits)
    found = caster.render(c2w, math.radians(degrees), 96, 96, supersample=2)
    assert expected[..., 3].max() == 1
    assert -10 * np.log10(np.square(found - expected).mean()) >= 40


@pytest.mark.parametrize("view", range(len(VIEWS)))
def test_the_toy_has_the_faces_that_embree_finds(toy, view):
    c2w, degrees = VIEWS[view]
    places = (np.arange(192) + 0.5) / 2 - 48
    camera = c2w, 48 / math.tan(math.radians(degrees) / 2), places, places
    expected, _ = raycast._embree_hits(raycast._embree_scene(toy), *camera)
    found, _ = ZBuffer(toy.vertices, toy.faces).hits(*camera)
    covered = (found >= 0) | (expected >= 0)
    assert (found == expected)[
        covered
    ].mean() > 0.995  # ties on edges, and Embree computes in float32


def test_the_weights_give_the_places_that_embree_finds():
    pytest.importorskip("embreex")
    vertices, faces = soup(1)
    camera = np.eye(4), FOCAL, PLACES, PLACES
    expected, expected_weights = raycast._embree_hits(
        raycast._embree_scene(Mesh(vertices, faces)), *camera
    )
    found, weights = draw(vertices, faces)
    same = (found == expected) & (found >= 0)
    assert same.sum() > 0.98 * (found >= 0).sum() > 200
    np.testing.assert_allclose(
        weights[same], expected_weights[same], atol=1e-4
    )  # float32 on triangles seen nearly on edge
