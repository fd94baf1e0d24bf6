"""A2: priors and first clouds that are degenerate, damaged, or in another unit; each is provoked
through the product's own doors.
"""

import itertools
from pathlib import Path

import numpy as np
import pytest
import scipy.spatial
import scipy.stats
import torch

from tests.stability.rows import row
from tests.stability.small_runs import launch
from threestudio_gaussiandreamer import register_parts
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
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.initialization import grow_points

register_parts()
CUBE = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
each_rule = pytest.mark.parametrize("rule", SCALE_RULES)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def sphere(count: int = 1000) -> np.ndarray:
    points = rng().normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def colored(points: np.ndarray, color: float = 0.5) -> PointCloud:
    return PointCloud(np.asarray(points, np.float32), np.full((len(points), 3), color, np.float32))


def started(cloud: PointCloud, **options) -> GaussianCloud:
    geometry = GaussianCloud({"grow": {"enabled": False}, **options})
    geometry.start_from(grow_points(cloud, geometry.cfg.grow))
    return geometry


def picture(geometry: GaussianCloud, frame: GaussianCloud | None = None) -> torch.Tensor:
    """Three views of a cloud, from where they would show ``frame``."""
    cloud, seen = (Gaussians.of(g).map(torch.Tensor.detach) for g in (geometry, frame or geometry))
    return render_all(cloud, views_around(seen, 3, 64))


# ---- distances -----------------------------------------------------------------------------------


@row("A2", "Duplicate points: distance 0 -> log 0")
@each_rule
def test_copies_have_a_size(rule, measured):
    """10 000 copies of one point; and of 2000 points every second one 9 times more."""
    one_place = started(colored(np.full((10_000, 3), 0.3)), scale_rule=rule)
    distinct = sphere(2000)
    half = started(
        colored(np.concatenate([distinct, np.repeat(distinct[::2], 9, axis=0)])), scale_rule=rule
    )
    for geometry in (one_place, half):
        assert geometry.log_scales.isfinite().all() and picture(geometry).isfinite().all()
    median = np.median(nearest_distance_scales(distinct, rule))
    measured(
        (half.scales()[2000:] / median - 1).abs().max(),
        "off the median of distinct points",
        at_most=0.01,
    )


@row("A2", "Duplicate points: distance 0 -> log 0")
@each_rule
def test_no_copy_is_ever_searched(rule, measured, monkeypatch):
    """A tree of distinct points has one in a leaf and O(N log N) to find it; copies can't be
    parted, and each would meet all others.
    """
    copies = []

    class Tree(scipy.spatial.cKDTree):
        def __init__(self, data, *args, **kwargs):
            copies.append(len(data) - len(np.unique(data, axis=0)))
            super().__init__(data, *args, **kwargs)

    monkeypatch.setattr(scipy.spatial, "cKDTree", Tree)
    cloud = colored(np.concatenate([sphere(2000), np.full((8000, 3), 0.3)]))
    nearest_distance_scales(cloud.points, rule)
    grow(cloud, num_candidates=1000, radius=0.05, generator=rng())
    assert len(copies) == 3  # for the sizes, for what is isolated, for the candidates
    measured(max(copies), "copies in a search tree", at_most=0)


@row("A2", "Isolated point: huge scale")
@each_rule
def test_an_isolated_point_is_capped_and_flagged(rule, measured, said):
    alone = nearest_distance_scales(sphere(), rule)
    geometry = started(colored(np.concatenate([sphere(), [[1000.0, 0, 0]]])), scale_rule=rule)
    largest = np.log(10 * np.quantile(np.append(alone, 1e3), 0.99))
    measured(
        np.exp(geometry.log_scales.max().item() - largest),
        "of 10 x the 99th percentile",
        at_most=1.0001,
    )
    assert np.array_equal(
        geometry.scales()[:-1, 0].detach(),
        started(colored(sphere()), scale_rule=rule).scales()[:, 0].detach(),
    )
    assert any("1 of 1001 points are isolated" in message for message in said)


@row("A2", "Isolated point: huge scale")
def test_an_isolated_point_does_not_stretch_the_growing(measured):
    """The box of all points would make the radius 500 times larger, and every candidate near the
    object a floater.
    """
    options = {"num_candidates": 20_000, "radius": 0.05}
    usual = grow(colored(sphere()), **options, generator=rng()).points[1000:]
    stray = grow(
        colored(np.concatenate([sphere(), [[1000.0, 0, 0]]])), **options, generator=rng()
    ).points[1001:]
    assert len(usual) > 500 and np.array_equal(usual, stray)
    measured("the same points grow")


@row("A2", "N<4")
@each_rule
@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_points(count, rule, measured):
    points = np.array([[0.0, 0, 0], [0.8, 0, 0], [0.4, 0.3, 0]])[:count]
    geometry = started(colored(points), scale_rule=rule)
    assert picture(geometry).isfinite().all()
    bounding_radius = [1.0, 0.4, np.hypot(0.4, 0.15)][count - 1]  # of one point: the world's unit
    measured(geometry.scales().max() / bounding_radius, "bounding radii", at_most=0.11)
    measured(geometry.scales().min() / bounding_radius, "bounding radii, smallest", at_least=0.09)


# ---- damaged sources -----------------------------------------------------------------------------


def write_ply(
    path: Path, points: np.ndarray, colors: np.ndarray | None = None, faces: np.ndarray | tuple = ()
) -> Path:
    names = ["x", "y", "z", *(["red", "green", "blue"] if colors is not None else [])]
    rows = points if colors is None else np.concatenate([points, colors], axis=1)
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in names),
    ]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines = (
        header
        + [" ".join(f"{x!r}" for x in values) for values in rows.tolist()]
        + [f"3 {a} {b} {c}" for a, b, c in faces]
    )
    path.write_text("\n".join(lines) + "\n")
    return path


def write_obj(path: Path, points: np.ndarray, faces: np.ndarray) -> Path:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def ball_mesh(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return np.array(ball.vertices), np.array(ball.faces)


NOTHING = {
    "empty.glb": "",
    "empty.obj": "",
    "empty.ply": "",
    "no_faces.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "one_vertex.obj": "v 1 2 3\n",
    "one_vertex.ply": "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty "
    "float y\nproperty float "
    "z\nend_header\n1 2 3\n",
    "one_vertex_face.obj": "v 1 2 3\nf 1 1 1\n",
    "no_area.off": "OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n",
}


@row("A2", "Empty mesh, zero faces, one vertex")
@pytest.mark.parametrize("name", NOTHING)
def test_a_mesh_of_nothing_ends_the_run_at_its_start(name, tmp_path, measured):
    """The whole command: a message that names the file, exit code 2, and no folder left."""
    (tmp_path / name).write_text(NOTHING[name])
    ended = launch(tmp_path / "outputs", f"system.geometry.prior.path={tmp_path / name}")
    (message,) = [line for line in ended.err.splitlines() if line.startswith("error")]
    assert ended.code == 2 and name in message and not (tmp_path / "outputs").exists()
    measured("exit 2, file named, no folder")


@row("A2", "Empty mesh, zero faces, one vertex")
def test_a_cloud_of_nothing_is_named(tmp_path, measured):
    path = write_ply(tmp_path / "empty.ply", np.zeros((0, 3)))
    with pytest.raises(UserError, match="empty|no points"):
        GaussianCloud({"prior_type": "point-cloud-prior", "prior": {"path": str(path)}}).initialize(
            "a prompt"
        )
    measured("points: named error")


def poisoned(values: np.ndarray, share: float) -> np.ndarray:
    """A share of the rows is NaN or infinite, in one of the columns."""
    values = values.copy()
    for i, index in enumerate(rng(1).choice(len(values), int(share * len(values)), replace=False)):
        values[index, i % values.shape[1]] = (np.nan, np.inf, -np.inf)[i % 3]
    return values


SOURCES = {
    "mesh": (
        "mesh-prior",
        lambda folder, points, colors, faces: write_ply(folder / "a.ply", points, colors, faces),
    ),
    "mesh without colours": (
        "mesh-prior",
        lambda folder, points, _, faces: write_obj(folder / "a.obj", points, faces),
    ),
    "points": (
        "point-cloud-prior",
        lambda folder, points, colors, _: write_ply(folder / "a.ply", points, colors),
    ),
    "rows of text": (
        "point-cloud-prior",
        lambda folder, points, colors, _: write_text(folder / "a.xyz", points, colors),
    ),
}
COLOURED = [source for source in SOURCES if source != "mesh without colours"]


def write_text(path: Path, points: np.ndarray, colors: np.ndarray) -> Path:
    np.savetxt(path, np.concatenate([points, colors], axis=1), "%.9g")
    return path


@row("A2", "NaN/Inf vertices, NaN colours")
@pytest.mark.parametrize(
    "source, what",
    [*itertools.product(SOURCES, ["vertices"]), *((source, "colours") for source in COLOURED)],
)
def test_a_few_bad_rows_are_counted_and_many_refused(source, what, tmp_path, measured, said):
    """1 % of 642 is 6. Where the faces have to stay whole a vertex without a colour becomes grey,
    else its point is dropped.
    """
    prior_type, write = SOURCES[source]
    points, faces = ball_mesh()
    arrays = {"vertices": points, "colours": rng().random(points.shape)}

    def initialized(share: float) -> GaussianCloud:
        path = write(tmp_path, *(arrays | {what: poisoned(arrays[what], share)}).values(), faces)
        geometry = GaussianCloud(
            {"prior_type": prior_type, "prior": {"path": str(path)}, "grow": {"enabled": False}}
        )
        geometry.initialize("a prompt")
        return geometry

    geometry = initialized(0.01)
    kept = 642 if source == "mesh" and what == "colours" else 636
    assert len(geometry) == kept and all(
        parameter.isfinite().all() for parameter in geometry.parameters()
    )
    grey = (geometry.colors(torch.zeros(1, 3)) == 0.5).all(1).sum()
    assert what == "vertices" or grey == (6 if source == "mesh" else 0)
    assert any("6 of 642" in message for message in said), said
    with pytest.raises(UserError, match="at most 5 %"):
        initialized(0.06)
    measured(642 - kept, "of 6 bad rows dropped, others repaired; 6 % refused")


@row("A2", "No colours")
@pytest.mark.parametrize("source", ["mesh", "points"])
def test_without_colours_the_cloud_is_grey_and_says_so(source, tmp_path, measured, said):
    points, faces = ball_mesh()
    if source == "mesh":
        prior = {
            "prior_type": "mesh-prior",
            "prior": {"path": str(write_obj(tmp_path / "a.obj", points, faces))},
        }
    else:
        np.savetxt(tmp_path / "a.xyz", points)
        prior = {"prior_type": "point-cloud-prior", "prior": {"path": str(tmp_path / "a.xyz")}}
    geometry = GaussianCloud({**prior, "grow": {"num_candidates": 20_000, "radius": 0.05}})
    geometry.initialize("a prompt")
    colors = geometry.colors(torch.zeros(1, 3)).detach()
    given, grown = colors[: len(points)], colors[len(points) :]
    measured((given - 0.5).abs().max(), "off grey", at_most=1e-6)
    assert (
        len(grown) > 300
        and grown.min() >= 0.5 - 1e-6
        and grown.max() <= 0.7 + 1e-6
        and grown.std() > 0.05
    )
    assert any("no colours: grey is used" in message for message in said)


# ---- unit and place ------------------------------------------------------------------------------


def initialized_from(path: Path) -> tuple[GaussianCloud, int]:
    """The first cloud of a file, brought into the world's frame, and how many points grew."""
    prior = (
        {"normalize": True} if path.suffix == ".npz" else {"num_points": 2000, "color": "random"}
    )  # grey on grey shows nothing
    kind = "point-cloud-prior" if path.suffix == ".npz" else "mesh-prior"
    options = {
        "prior_type": kind,
        "prior": prior | {"path": str(path)},
        "grow": {"num_candidates": 20_000, "radius": 0.05},
    }
    geometry = GaussianCloud(options)
    geometry.initialize("a prompt")
    return geometry, len(geometry) - (642 if path.suffix == ".npz" else 2000)


def write_npz(path: Path, points: np.ndarray) -> Path:
    np.savez(path, points=points, colors=rng().random(points.shape))
    return path


@row("A2", "Units and pose")
@pytest.mark.parametrize("kind", ["obj", "npz"])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_neither_unit_nor_place_matters(unit, kind, tmp_path, measured):
    """Millimetres, metres, kilometres, each where it is and 10 000 units away."""
    points, faces = ball_mesh()
    write = write_npz if kind == "npz" else lambda path, points: write_obj(path, points, faces)
    (tmp_path / "b").mkdir()
    usual, expected = initialized_from(write(tmp_path / f"a.{kind}", points))
    for shift in (0.0, 1e4):
        other, count = initialized_from(write(tmp_path / f"b/a.{kind}", points * unit + shift))
        measured(abs(count / expected - 1) * 100, "%", what="share accepted: off by", at_most=1.0)
        n = min(len(usual), len(other))
        assert torch.allclose(other.means[:n], usual.means[:n], atol=1e-4)
        measured(
            psnr(picture(other, usual), picture(usual)).min(),
            "dB",
            what="same picture",
            at_least=50.0,
        )


@row("A2", "Units and pose")
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_growing_has_no_unit(unit, shift, measured):
    """Of points that stay where they are."""
    options = {"num_candidates": 20_000, "radius": 0.05}
    cloud = colored(sphere())
    counts = [
        len(grow(cloud._replace(points=points), **options, generator=rng()).points)
        for points in (sphere(), sphere() * unit + shift)
    ]
    measured(
        abs((counts[1] - 1000) / (counts[0] - 1000) - 1) * 100,
        "%",
        what="share accepted: off by",
        at_most=1.0,
    )


# ---- degenerate shapes ---------------------------------------------------------------------------


@row("A2", "Flat, needle, point bbox")
@pytest.mark.parametrize("axes", [(0, 1), (2,), ()], ids=["plane", "line", "point"])
def test_a_flat_prior_grows_a_slab_within_the_caps(axes, measured):
    points = np.full((500, 3), 0.25)
    points[:, axes] = rng().uniform(-1, 1, (500, len(axes)))
    reach = 0.05 * (longest_side(points) or 1.0)
    flat = [axis for axis in range(3) if axis not in axes]
    options = {"num_candidates": 50_000, "radius": 0.05, "max_points": 2000}
    geometry = started(colored(points), grow={"enabled": True, **options})
    measured(len(geometry) - 500, "grown, of at most 2000", at_most=2000)
    offsets = (geometry.means[500:, flat] - 0.25).abs().detach()
    assert (
        offsets.max() <= 1.0001 * reach and (offsets.amax(0) > 0.9 * reach).all()
    )  # it fills the slab, and no more
    assert picture(geometry).isfinite().all() and geometry.log_scales.isfinite().all()
    assert (
        len(started(colored(points), grow={"enabled": True, **options}, max_gaussians=700)) == 700
    )


@row("A2", "No grown point")
def test_a_cube_alone(measured):
    geometry = started(
        colored(CUBE), grow={"enabled": True, "num_candidates": 100_000, "radius": 0.0025}
    )
    assert torch.equal(geometry.means, torch.from_numpy(CUBE).float())
    assert torch.allclose(geometry.colors(torch.zeros(1, 3)), torch.tensor(0.5))
    assert picture(geometry).isfinite().all()
    measured(len(geometry), "Gaussians, the vertices", at_most=8)


def uneven_square() -> tuple[np.ndarray, np.ndarray]:
    """A square of 162 triangles of very different sizes, and a tenth more without area: on a line,
    and with a corner twice.
    """
    ticks = np.concatenate([[0.0], np.sort(rng(3).random(8)) ** 2, [1.0]])
    points = np.array([(x, y, 0.0) for x in ticks for y in ticks])
    corner = (10 * np.arange(9)[:, None] + np.arange(9)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 10, 1], corner + [10, 11, 1]])
    without_area = np.concatenate([corner[::9] + [0, 1, 2], corner[1::9] + [0, 0, 1]])
    return points, np.concatenate([faces, without_area])


def uniformity(points: np.ndarray) -> float:
    """The smaller p of the Kolmogorov-Smirnov tests that both coordinates are uniform on [-1,
    1].
    """
    return min(scipy.stats.kstest(axis, "uniform", (-1, 2)).pvalue for axis in points.T[:2])


@row("A2", "Non-manifold, duplicate faces, degenerate triangles")
@pytest.mark.parametrize("repeated", ["not", "same", "turned round", "with copied vertices"])
def test_a_surface_is_sampled_uniformly_whatever_its_faces(repeated, tmp_path, measured):
    """Repeated faces, which make every edge of theirs non-manifold, lie on one side: counted twice,
    that side would be denser.
    """
    points, faces = uneven_square()
    again = faces[:40] if repeated != "turned round" else faces[:40, ::-1]
    if repeated == "with copied vertices":
        again, points = again + len(points), np.concatenate([points, points])
    faces = faces if repeated == "not" else np.concatenate([faces, again])
    mesh = load_mesh(write_ply(tmp_path / "square.ply", points, faces=faces))
    sampled, face_index, _ = sample_surface(mesh, 5000, rng())
    assert (face_areas(mesh) == 0).sum() >= 18 and (face_areas(mesh)[face_index] > 0).all()
    measured(uniformity(sampled), what="p of the worse axis", at_least=0.01)
    if repeated != "not":
        twice = rng().choice(len(mesh.faces), 5000, p=face_areas(mesh) / face_areas(mesh).sum())
        assert uniformity(mesh.vertices[mesh.faces[twice]].mean(1)) < 0.01  # the test can fail


@row("A2", "Colour perturbation")
@pytest.mark.parametrize(
    "color_range, mean", [((0.0, 0.2), 0.1), ((-0.1, 0.1), 0.0)], ids=["the paper's", "zero mean"]
)
def test_noise_stays_in_its_range_and_colours_in_theirs(color_range, mean, measured):
    """Middle grey shows the noise itself, its histogram flat to 5 standard errors; nearly white
    shows the clamp.
    """
    options = {
        "enabled": True,
        "num_candidates": 40_000,
        "radius": 0.05,
        "color_range": list(color_range),
    }

    def grown(color: float, **more) -> np.ndarray:
        return grow_points(
            colored(sphere(), color), GaussianCloud({"grow": options | more}).cfg.grow
        ).colors[1000:]

    noise = grown(0.5) - 0.5
    counts, expected = np.histogram(noise, 10, color_range)[0], noise.size / 10
    assert counts.sum() >= noise.size - 2 and np.abs(counts - expected).max() < 5 * np.sqrt(
        expected
    )  # 2: rounding at the ends
    measured(abs(noise.mean() - mean), what=f"mean of the noise off {mean:g}", at_most=0.003)
    measured(grown(0.95).max(), what="brightest", at_most=1.0)
    assert grown(0.05).min() >= 0.0 and grown(0.95, clamp=False).max() > 1.03
