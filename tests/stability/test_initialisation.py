"""A2: priors and first clouds that are degenerate, damaged, or in another unit, given through the
package's own readers."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import scipy.spatial
import scipy.stats
import torch
import trimesh

from tests.helpers.ply_files import ply_bytes, rng
from tests.stability.report import row
from tests.stability.scenes import ball
from tests.stability.small_runs import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.grow import (
    SCALE_RULES,
    grow,
    longest_side,
    nearest_distance_scales,
)
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.gaussians.views import render_all, views_around
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import face_areas, sample_surface
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.training.geometry import GaussianCloud, grow_points


def sphere(count: int = 1000) -> np.ndarray:
    return ball(count).points / 0.7


def colored(points: np.ndarray, color: float = 0.5) -> PointCloud:
    return PointCloud(np.asarray(points, np.float32), np.full((len(points), 3), color, np.float32))


GROWING = {"num_candidates": 20_000, "radius": 0.05}
FAR = [[1000.0, 0, 0]]


def started(cloud: PointCloud, **options) -> GaussianCloud:
    geometry = GaussianCloud({"grow": {"enabled": False}, **options})
    geometry.start_from(grow_points(cloud, geometry.cfg.grow))
    return geometry


def initialized(prior_type: str, path: Path, prior: dict | None = None, **grow) -> GaussianCloud:
    """Return the first cloud from a file."""
    prior = {"path": str(path), **(prior or {})}
    geometry = GaussianCloud({"prior_type": prior_type, "prior": prior, "grow": grow})
    geometry.initialize("a prompt")
    return geometry


def picture(geometry: GaussianCloud, frame: GaussianCloud | None = None) -> torch.Tensor:
    """Render three views of a cloud from cameras that frame ``frame``."""
    cloud, seen = (Gaussians.of(g).map(torch.Tensor.detach) for g in (geometry, frame or geometry))
    return render_all(cloud, views_around(seen, 3, 64))


def write(path: Path, points: np.ndarray, colors: np.ndarray | None = None, faces=()) -> Path:
    """Write what a file of this suffix can hold: .obj without colours, .xyz and .npz no faces."""
    rows = points if colors is None else np.concatenate([points, colors], axis=1)
    columns = zip((*"xyz", "red", "green", "blue"), rows.T, strict=False)
    if path.suffix == ".obj":
        lines = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()]
        path.write_text("".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)]))
    elif path.suffix == ".xyz":
        np.savetxt(path, rows, "%.9g")
    elif path.suffix == ".npz":
        np.savez(path, points=points, colors=colors)
    else:
        text = f"element face {len(faces)}\nproperty list uchar int vertex_indices"
        body = b"".join(b"3 %d %d %d\n" % tuple(face) for face in faces)
        columns = {name: ("float", column) for name, column in columns}
        path.write_bytes(ply_bytes(columns, after=(text, body)))
    return path


def ball_mesh(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions)
    return np.array(ball.vertices), np.array(ball.faces)


each_rule = pytest.mark.parametrize("rule", SCALE_RULES)


@row("A2", "Duplicate points: distance 0 -> log 0")
@each_rule
def test_duplicate_points_have_a_finite_scale(rule, measured):
    """10 000 copies of one point; and of 2000 points every second one 9 times more."""
    one_place = started(colored(np.full((10_000, 3), 0.3)), scale_rule=rule)
    distinct = sphere(2000)
    repeated = np.concatenate([distinct, np.repeat(distinct[::2], 9, axis=0)])
    half = started(colored(repeated), scale_rule=rule)
    for geometry in (one_place, half):
        assert geometry.log_scales.isfinite().all() and picture(geometry).isfinite().all()
    median = np.median(nearest_distance_scales(distinct, rule))
    off = (half.scales()[2000:] / median - 1).abs().max()
    measured(off, "off the median of distinct points", at_most=0.01)


@row("A2", "Duplicate points: distance 0 -> log 0")
@each_rule
def test_duplicates_are_not_in_the_search_tree(rule, measured, monkeypatch):
    """Copies can't be separated, so each would visit all others."""
    copies = []

    class Tree(scipy.spatial.cKDTree):
        def __init__(self, data, *args, **kwargs):
            copies.append(len(data) - len(np.unique(data, axis=0)))
            super().__init__(data, *args, **kwargs)

    monkeypatch.setattr(scipy.spatial, "cKDTree", Tree)
    cloud = colored(np.concatenate([sphere(2000), np.full((8000, 3), 0.3)]))
    nearest_distance_scales(cloud.points, rule)
    grow(cloud, num_candidates=1000, radius=0.05, generator=rng())
    assert len(copies) == 2  # scales, growing
    measured(max(copies), "copies in a search tree", at_most=0)


@row("A2", "Isolated point: huge scale")
@each_rule
def test_an_isolated_point_is_capped_and_flagged(rule, measured, said):
    usual = started(colored(sphere()), scale_rule=rule).scales()[:, 0].detach()
    geometry = started(colored(np.concatenate([sphere(), FAR])), scale_rule=rule)
    alone = nearest_distance_scales(sphere(), rule)
    largest = np.log(10 * np.quantile(np.append(alone, 1e3), 0.99))
    share = np.exp(geometry.log_scales.max().item() - largest)
    measured(share, "of 10 x the 99th percentile", at_most=1.0001)
    assert np.array_equal(geometry.scales()[:-1, 0].detach(), usual)
    assert "1 of 1001 points are isolated" in said.text


@row("A2", "Isolated point: huge scale")
def test_an_isolated_point_does_not_stretch_the_growing(measured):
    """The bounding box of all points would make the radius 500 times larger."""
    both = sphere(), np.concatenate([sphere(), FAR])
    usual, stray = (grow(colored(p), **GROWING, generator=rng()).points[len(p) :] for p in both)
    assert len(usual) > 500 and np.array_equal(usual, stray)
    measured("the same points grow")


@row("A2", "N<4")
@each_rule
@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_points(count, rule, measured):
    points = np.array([[0.0, 0, 0], [0.8, 0, 0], [0.4, 0.3, 0]])[:count]
    geometry = started(colored(points), scale_rule=rule)
    assert picture(geometry).isfinite().all()
    bounding_radius = [1.0, 0.4, np.hypot(0.4, 0.15)][count - 1]  # one point: the unit of the world
    measured(geometry.scales().max() / bounding_radius, "bounding radii", at_most=0.11)
    measured(geometry.scales().min() / bounding_radius, "bounding radii, smallest", at_least=0.09)


NOTHING = dict.fromkeys(("empty.glb", "empty.obj", "empty.ply"), "") | {
    "no_faces.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "one_vertex.obj": "v 1 2 3\n",
    "one_vertex.ply": "ply\nformat ascii 1.0\nelement vertex 1\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n",
    "one_vertex_face.obj": "v 1 2 3\nf 1 1 1\n",
    "no_area.off": "OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n",
}


@row("A2", "Empty mesh, zero faces, one vertex")
@pytest.mark.parametrize("name", NOTHING)
def test_an_empty_mesh_ends_the_run_at_its_start(name, tmp_path, measured):
    """The command gives a message that names the file, exit code 2, and no folder."""
    (tmp_path / name).write_text(NOTHING[name])
    given = f"system.geometry.prior.path={tmp_path / name}"
    ended = refused(tmp_path / "outputs", given, words=[name])
    assert name in ended.err.partition("error: ")[2] and not (tmp_path / "outputs").exists()
    measured("exit 2, file named, no folder")


@row("A2", "Empty mesh, zero faces, one vertex")
def test_an_empty_point_cloud_is_named(tmp_path, measured):
    path = write(tmp_path / "empty.ply", np.zeros((0, 3)))
    with pytest.raises(UserError, match="empty|no points"):
        initialized("point-cloud-prior", path)
    measured("points: named error")


def corrupted(values: np.ndarray, share: float) -> np.ndarray:
    """Set a share of the rows to NaN or infinity, in one of the columns."""
    values = values.copy()
    for i, index in enumerate(rng(1).choice(len(values), int(share * len(values)), replace=False)):
        values[index, i % values.shape[1]] = (np.nan, np.inf, -np.inf)[i % 3]
    return values


COLOURED = [("mesh", "ply"), ("point-cloud", "ply"), ("point-cloud", "xyz")]


@row("A2", "NaN/Inf vertices, NaN colours")
@pytest.mark.parametrize("what, source", [
    ("vertices", ("mesh", "obj")), *itertools.product(["vertices", "colours"], COLOURED)
])  # fmt: skip
def test_a_few_bad_rows_are_counted_and_many_refused(source, what, tmp_path, measured, said):
    """A vertex of kept faces without a colour becomes grey; otherwise its point is dropped."""
    (kind, suffix), (points, faces) = source, ball_mesh()
    arrays = {"vertices": points, "colours": rng().random(points.shape)}

    def with_bad(share: float) -> GaussianCloud:
        changed = arrays | {what: corrupted(arrays[what], share)}
        own = faces if kind == "mesh" else ()
        path = write(tmp_path / f"a.{suffix}", *changed.values(), own)
        return initialized(f"{kind}-prior", path, enabled=False)

    geometry = with_bad(0.01)
    kept = 642 if kind == "mesh" and what == "colours" else 636
    assert len(geometry) == kept
    assert all(parameter.isfinite().all() for parameter in geometry.parameters())
    grey = (geometry.colors(torch.zeros(1, 3)) == 0.5).all(1).sum()
    assert what == "vertices" or grey == (6 if kind == "mesh" else 0)
    assert "6 of 642" in said.text
    with pytest.raises(UserError, match="at most 5 %"):
        with_bad(0.06)
    measured(642 - kept, "of 6 bad rows dropped, others repaired; 6 % refused")


@row("A2", "No colours")
@pytest.mark.parametrize("kind, suffix", [("mesh", "obj"), *COLOURED[1:]])
def test_without_colours_the_cloud_is_grey_with_a_message(kind, suffix, tmp_path, measured, said):
    points, faces = ball_mesh()
    path = write(tmp_path / f"a.{suffix}", points, faces=faces if kind == "mesh" else ())
    colors = initialized(f"{kind}-prior", path, **GROWING).colors(torch.zeros(1, 3)).detach()
    given, grown = colors[: len(points)], colors[len(points) :]
    measured((given - 0.5).abs().max(), "off grey", at_most=1e-6)
    assert len(grown) > 300 and grown.std() > 0.05
    assert grown.min() >= 0.5 - 1e-6 and grown.max() <= 0.7 + 1e-6
    assert "no colours: grey is used" in said.text


def initialized_from(path: Path) -> tuple[GaussianCloud, int]:
    """Return the first cloud of a file in the world's frame, and the number of grown points."""
    points = path.suffix == ".npz"
    prior = {"normalize": True} if points else {"num_points": 2000, "color": "random"}
    geometry = initialized(f"{'point-cloud' if points else 'mesh'}-prior", path, prior, **GROWING)
    return geometry, len(geometry) - (642 if points else 2000)


@row("A2", "Units and pose")
@pytest.mark.parametrize("kind", ["obj", "npz"])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_neither_unit_nor_place_matters(unit, kind, tmp_path, measured):
    """Millimetres, metres, kilometres, each at its place and 10 000 units away."""
    points, faces = ball_mesh()

    def written(points: np.ndarray) -> Path:
        return write(tmp_path / f"a.{kind}", points, rng().random(points.shape), faces)

    usual, expected = initialized_from(written(points))
    for shift in (0.0, 1e4):
        other, count = initialized_from(written(points * unit + shift))
        off = abs(count / expected - 1) * 100
        measured(off, "%", what="deviation of the accepted share", at_most=1.0)
        n = min(len(usual), len(other))
        assert torch.allclose(other.means[:n], usual.means[:n], atol=1e-4)
        quality = psnr(picture(other, usual), picture(usual)).min()
        measured(quality, "dB", what="PSNR after normalisation", at_least=50.0)


@row("A2", "Flat, needle, point bbox")
@pytest.mark.parametrize("axes", [(0, 1), (2,), ()], ids=["plane", "line", "point"])
def test_a_flat_prior_grows_a_slab_within_the_caps(axes, measured):
    points = np.full((500, 3), 0.25)
    points[:, axes] = rng().uniform(-1, 1, (500, len(axes)))
    reach = 0.05 * (longest_side(points) or 1.0)
    flat = [axis for axis in range(3) if axis not in axes]
    options = {"enabled": True, "num_candidates": 50_000, "radius": 0.05, "max_points": 2000}
    geometry = started(colored(points), grow=options)
    measured(len(geometry) - 500, "grown, of at most 2000", at_most=2000)
    offsets = (geometry.means[500:, flat] - 0.25).abs().detach()
    # it fills the slab only
    assert offsets.max() <= 1.0001 * reach and (offsets.amax(0) > 0.9 * reach).all()
    assert picture(geometry).isfinite().all() and geometry.log_scales.isfinite().all()
    assert len(started(colored(points), grow=options, max_gaussians=700)) == 700


@row("A2", "No grown point")
def test_a_cube_without_grown_points(measured):
    few = {"enabled": True, "num_candidates": 100_000, "radius": 0.0025}
    cube = colored(list(itertools.product((-1.0, 1.0), repeat=3)))
    geometry = started(cube, grow=few)
    assert torch.equal(geometry.means, torch.from_numpy(cube.points))
    assert torch.allclose(geometry.colors(torch.zeros(1, 3)), torch.tensor(0.5))
    assert picture(geometry).isfinite().all()
    measured(len(geometry), "Gaussians, the vertices", at_most=8)


def uneven_square() -> tuple[np.ndarray, np.ndarray]:
    """Return a square of 162 triangles of very different sizes, and a tenth more without area."""
    ticks = np.concatenate([[0.0], np.sort(rng(3).random(8)) ** 2, [1.0]])
    points = np.array([(x, y, 0.0) for x in ticks for y in ticks])
    corner = (10 * np.arange(9)[:, None] + np.arange(9)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 10, 1], corner + [10, 11, 1]])
    without_area = np.concatenate([corner[::9] + [0, 1, 2], corner[1::9] + [0, 0, 1]])
    return points, np.concatenate([faces, without_area])


def uniformity(points: np.ndarray) -> float:
    """Return the smaller p of the tests that both coordinates are uniform on [-1, 1]."""
    return min(scipy.stats.kstest(axis, "uniform", (-1, 2)).pvalue for axis in points.T[:2])


@row("A2", "Non-manifold, duplicate faces, degenerate triangles")
@pytest.mark.parametrize("repeated", ["not", "same", "reversed", "with copied vertices"])
def test_a_surface_is_sampled_uniformly_for_any_triangulation(repeated, tmp_path, measured):
    """Repeated faces are on one side: counted twice, that side would be denser."""
    points, faces = uneven_square()
    again = faces[:40] if repeated != "reversed" else faces[:40, ::-1]
    if repeated == "with copied vertices":
        again, points = again + len(points), np.concatenate([points, points])
    faces = faces if repeated == "not" else np.concatenate([faces, again])
    mesh = load_mesh(write(tmp_path / "square.ply", points, faces=faces))
    sampled, face_index, _ = sample_surface(mesh, 5000, rng())
    areas = face_areas(mesh)
    assert (areas == 0).sum() >= 18 and (areas[face_index] > 0).all()
    measured(uniformity(sampled), what="p of the worse axis", at_least=0.01)
    if repeated != "not":
        twice = rng().choice(len(mesh.faces), 5000, p=areas / areas.sum())
        assert uniformity(mesh.vertices[mesh.faces[twice]].mean(1)) < 0.01


@row("A2", "Colour perturbation")
@pytest.mark.parametrize(
    "color_range, mean", [((0.0, 0.2), 0.1), ((-0.1, 0.1), 0.0)], ids=["the paper's", "zero mean"]
)
def test_noise_stays_in_its_range_and_colours_in_theirs(color_range, mean, measured):
    """Middle grey shows the noise itself, nearly white the clamp."""
    options = {"num_candidates": 40_000, "radius": 0.05, "color_range": list(color_range)}
    growing = GaussianCloud({"grow": {"enabled": True, **options}}).cfg.grow

    def grown(color: float) -> np.ndarray:
        return grow_points(colored(sphere(), color), growing).colors[1000:]

    noise = grown(0.5) - 0.5
    counts, expected = np.histogram(noise, 10, color_range)[0], noise.size / 10
    assert counts.sum() >= noise.size - 2  # rounding at the ends
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)
    measured(abs(noise.mean() - mean), what=f"mean of the noise off {mean:g}", at_most=0.003)
    measured(grown(0.95).max(), what="brightest", at_most=1.0)
