import logging
import math
import sys

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes import raycast
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import Mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster, TargetCache, over_background

trimesh = pytest.importorskip("trimesh")

COLORS = {
    "+x": (1, 0, 0),
    "-x": (0, 1, 1),
    "+y": (0, 1, 0),
    "-y": (1, 0, 1),
    "+z": (0, 0, 1),
    "-z": (1, 1, 0),
}


@pytest.fixture(params=["embree", "zbuffer"], autouse=True)
def caster_name(request, monkeypatch):
    """Run every test with both casters."""
    if request.param == "zbuffer":
        monkeypatch.setitem(
            sys.modules, "embreex.mesh_construction", None
        )  # importing it is an ImportError now
    else:
        pytest.importorskip("embreex")
    return request.param


def look(elevation, azimuth, distance):
    angles = (
        torch.tensor([float(value)], dtype=torch.float64)
        for value in (elevation, azimuth, distance)
    )
    return cameras.orbit_c2w(*angles)[0].numpy()


def cube(size=1.0):
    """Return a cube with one colour per side."""
    source = trimesh.creation.box((size, size, size))
    sides = source.face_normals.round().astype(int)
    names = ["+-"[int(side.sum() < 0)] + "xyz"[int(np.abs(side).argmax())] for side in sides]
    return Mesh(
        np.array(source.vertices),
        np.array(source.faces),
        face_colors=np.array([COLORS[name] for name in names], dtype=np.float32),
    )


def sphere(radius=1.0, subdivisions=5):
    source = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(np.array(source.vertices), np.array(source.faces))


@pytest.mark.parametrize(
    ("distance", "fovy", "size"),
    [(2.0, 70.0, (96, 96)), (3.0, 40.0, (80, 120)), (5.0, 25.0, (96, 80))],
)
def test_the_silhouette_of_a_sphere(distance, fovy, size):
    """In perspective a sphere of radius r at distance d subtends the angle asin(r / d): a disc of
    radius f tan of it.
    """
    height, width = size
    image = MeshCaster(sphere(0.8)).render(
        look(20, 30, distance), math.radians(fovy), height, width, supersample=4
    )
    focal = height / (2 * math.tan(math.radians(fovy) / 2))
    radius = focal * math.tan(math.asin(0.8 / distance))
    # the icosphere's edges lie 5e-4 inside; 16 samples a pixel leave about 0.2 % of the area
    np.testing.assert_allclose(image[..., 3].sum(), math.pi * radius**2, rtol=5e-3)
    rows, columns = np.nonzero(image[..., 3] > 0.5)
    assert abs(rows.mean() + 0.5 - height / 2) < 0.1 and abs(columns.mean() + 0.5 - width / 2) < 0.1
    for span in (np.ptp(rows), np.ptp(columns)):
        assert abs(span + 1 - 2 * radius) < 1.5


@pytest.mark.parametrize(
    ("side", "elevation", "azimuth"),
    [
        ("+x", 0, 0),
        ("+y", 0, 90),
        ("-x", 0, 180),
        ("-y", 0, -90),
        ("+z", 89.9, 0),
        ("-z", -89.9, 0),
    ],
)
def test_each_side_of_a_cube_is_seen_from_its_side(side, elevation, azimuth):
    image = MeshCaster(cube()).render(look(elevation, azimuth, 3), math.radians(40), 32, 32)
    np.testing.assert_allclose(image[16, 16], [*COLORS[side], 1], atol=1e-6)


def test_the_picture_is_not_mirrored():
    """From the front, +y is on the right and +z on top."""
    image = MeshCaster(cube()).render(look(30, 30, 3), math.radians(40), 64, 64)
    rows, columns = np.nonzero(
        (image[..., 1] > 0.9) & (image[..., 0] < 0.1) & (image[..., 2] < 0.1)
    )  # green: +y
    assert columns.mean() > 36
    rows, columns = np.nonzero((image[..., 2] > 0.9) & (image[..., 0] < 0.1))  # blue: +z
    assert rows.mean() < 24


def test_a_point_lands_where_the_intrinsics_say():
    position = np.array([0.3, -0.2, 0.4])
    mesh = sphere(0.02, 2)
    mesh = mesh._replace(vertices=mesh.vertices + position)
    c2w, fovy, height, width = look(25, 70, 2.5), math.radians(50), 60, 100
    image = MeshCaster(mesh).render(c2w, fovy, height, width, supersample=8)
    viewmats, Ks = cameras.to_opencv(torch.tensor(c2w)[None], torch.tensor([fovy]), height, width)
    projected = Ks[0].double() @ (viewmats[0, :3, :3] @ torch.tensor(position) + viewmats[0, :3, 3])
    weights = image[..., 3] / image[..., 3].sum()
    center = [
        (weights * (np.arange(width) + 0.5)).sum(),
        (weights * (np.arange(height) + 0.5)[:, None]).sum(),
    ]
    np.testing.assert_allclose(
        center, (projected[:2] / projected[2]).numpy(), atol=0.05
    )  # the disc is 2 pixels wide


def test_gltf_files_show_their_front_at_azimuth_0(tmp_path):
    """glTF is y up and faces +z; its +x is the model's left, which is the world's +y."""
    source = cube()
    corners, colors = (
        source.vertices[source.faces].reshape(-1, 3),
        (source.face_colors.repeat(3, axis=0) * 255).astype(np.uint8),
    )
    trimesh.Trimesh(
        corners, np.arange(36).reshape(-1, 3), vertex_colors=colors, process=False
    ).export(tmp_path / "cube.glb")
    caster = MeshCaster(load_mesh(tmp_path / "cube.glb"))
    for elevation, azimuth, side in ((0, 0, "+z"), (0, 90, "+x"), (89.9, 0, "+y")):
        image = caster.render(look(elevation, azimuth, 4), math.radians(40), 16, 16)
        np.testing.assert_allclose(image[8, 8, :3], COLORS[side], atol=1e-6)


def test_colour_is_premultiplied_and_coverage_partial_at_edges():
    image = MeshCaster(cube()).render(look(0, 0, 3), math.radians(40), 30, 30, supersample=4)
    edge = (image[..., 3] > 0) & (image[..., 3] < 1)
    assert edge.any()
    np.testing.assert_allclose(image[..., 0], image[..., 3], atol=1e-6)  # the front is red
    over = over_background(image, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(over[..., :2].sum(axis=-1), 1, atol=1e-6)


def test_supersampling_is_the_mean_of_a_larger_picture():
    caster = MeshCaster(cube())
    view = look(30, 40, 2.5), math.radians(50)
    large = caster.render(*view, 48, 72, 1).reshape(16, 3, 24, 3, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(caster.render(*view, 16, 24, 3), large, atol=1e-6)


def test_casting_in_parts_changes_nothing(monkeypatch):
    caster = MeshCaster(cube())
    view = look(30, 40, 2.5), math.radians(50), 20, 20, 4
    whole = caster.render(*view)
    monkeypatch.setattr("threestudio_gaussiandreamer.meshes.raycast.RAYS_PER_CAST", 1)
    np.testing.assert_allclose(caster.render(*view), whole, atol=1e-6)  # sums in another order


def test_cameras_inside_beside_and_away():
    caster = MeshCaster(cube())
    inside, away = look(10, 20, 0.1), look(10, 20, 3)
    away[:3, :3] *= [-1, 1, -1]  # looks the other way
    assert caster.render(inside, 1.0, 8, 8)[..., 3].min() == 1
    assert caster.render(away, 1.0, 8, 8).max() == 0
    beside = look(0, 0, 3)
    beside[1, 3] += 50
    assert caster.render(beside, 1.0, 8, 8).max() == 0


def test_many_views_are_the_single_views():
    caster = MeshCaster(cube())
    views = [(look(10 * i, 40 * i, 2 + 0.1 * i), 0.8) for i in range(6)]
    together = caster.render_views(views, 12, 18, supersample=2)
    for image, view in zip(together, views, strict=True):
        np.testing.assert_array_equal(image, caster.render(*view, 12, 18, 2))
    assert caster.render_views([], 12, 18).shape == (0, 12, 18, 4)


def orbit_tensors(*azimuths):
    azimuth = torch.tensor([float(a) for a in azimuths])
    return cameras.orbit_c2w(
        torch.zeros_like(azimuth), azimuth, torch.full_like(azimuth, 3)
    ), torch.full_like(azimuth, 0.7)


def test_the_cache_returns_the_pictures_and_casts_each_once(monkeypatch):
    caster = MeshCaster(cube())
    cache = TargetCache(caster, 2, capacity=8)
    c2w, fovy = orbit_tensors(0, 90, 0)
    first = cache(c2w, fovy, 10, 12)
    assert first.dtype == torch.uint8 and len(cache) == 2
    expected = caster.render(c2w[1].numpy(), float(fovy[1]), 10, 12, 2)
    np.testing.assert_allclose(first[1] / 255.0, expected, atol=0.5 / 255 + 1e-6)
    monkeypatch.setattr(caster, "render", lambda *args, **kwargs: pytest.fail("cast again"))
    assert torch.equal(cache(c2w, fovy, 10, 12), first)


def test_the_cache_is_bounded_and_drops_the_oldest_use():
    caster = MeshCaster(cube())
    cache = TargetCache(caster, 1, capacity=3)
    for azimuth in (0, 10, 20, 0, 30):
        cache(*orbit_tensors(azimuth), 4, 4)
    kept = {np.frombuffer(key[0], dtype=np.float32).tobytes() for key in cache._pictures}
    assert len(cache) == 3
    assert kept == {orbit_tensors(a)[0][0].numpy().tobytes() for a in (20, 0, 30)}
    assert cache(*orbit_tensors(1, 2, 3, 4, 5), 4, 4).shape == (
        5,
        4,
        4,
        4,
    )  # a batch larger than the cache
    cache(*orbit_tensors(5), 4, 4)
    cache(*orbit_tensors(5), 8, 4)
    assert len(cache) == 3


def test_sizes_are_checked():
    with pytest.raises(UserError, match="at least 1"):
        MeshCaster(cube()).render(look(0, 0, 3), 0.7, 0, 8)


def test_a_missing_embree_is_reported_once(caster_name, caplog):
    raycast._report_slow_caster.cache_clear()
    with caplog.at_level(logging.WARNING, logger=raycast.__name__):
        MeshCaster(cube())
        MeshCaster(cube())
    lines = [
        record.getMessage()
        for record in caplog.records
        if "pip install embreex" in record.getMessage()
    ]
    assert len(lines) == (1 if caster_name == "zbuffer" else 0)


@pytest.mark.parametrize("terminal", [True, False])
def test_the_progress_bar_is_for_terminals(terminal, capfd, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    views = [(look(0, 0, 3), 0.8)] * 2
    MeshCaster(cube()).render_views(views, 4, 4, progress="bank of views")
    assert ("bank of views" in capfd.readouterr().err) == terminal
    MeshCaster(cube()).render_views(views, 4, 4)
    assert not capfd.readouterr().err
