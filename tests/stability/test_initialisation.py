"""A2: priors and first clouds that are degenerate, damaged, or in another unit, given through the
package's own readers.
"""

import itertools
from pathlib import Path

import numpy as np
import pytest
import scipy.spatial
import scipy.stats
import torch
import trimesh

from tests.stability.initialisation_cases import (
    ball_mesh,
    colored,
    picture,
    rng,
    sphere,
    started,
    write_obj,
    write_ply,
)
from tests.stability.rows import row
from tests.stability.small_runs import launch
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.grow import (
    SCALE_RULES,
    grow,
    nearest_distance_scales,
)
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

register_parts()


each_rule = pytest.mark.parametrize("rule", SCALE_RULES)


# ---- distances -----------------------------------------------------------------------------------


@row("A2", "Duplicate points: distance 0 -> log 0")
@each_rule
def test_duplicate_points_have_a_finite_scale(rule, measured):
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
def test_duplicates_are_not_in_the_search_tree(rule, measured, monkeypatch):
    """A search tree of distinct points has one point per leaf and finds it in O(N log N); copies
    can't be separated, so each would visit all others.
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
    assert len(copies) == 2  # scales, growing
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
    """The bounding box of all points would make the radius 500 times larger, and every candidate
    near the object a floater.
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
    bounding_radius = [1.0, 0.4, np.hypot(0.4, 0.15)][count - 1]  # one point: the unit of the world
    measured(geometry.scales().max() / bounding_radius, "bounding radii", at_most=0.11)
    measured(geometry.scales().min() / bounding_radius, "bounding radii, smallest", at_least=0.09)


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
def test_an_empty_mesh_ends_the_run_at_its_start(name, tmp_path, measured):
    """The command gives a message that names the file, exit code 2, and no folder."""
    (tmp_path / name).write_text(NOTHING[name])
    ended = launch(tmp_path / "outputs", f"system.geometry.prior.path={tmp_path / name}")
    (message,) = [line for line in ended.err.splitlines() if line.startswith("error")]
    assert ended.code == 2 and name in message and not (tmp_path / "outputs").exists()
    measured("exit 2, file named, no folder")


@row("A2", "Empty mesh, zero faces, one vertex")
def test_an_empty_point_cloud_is_named(tmp_path, measured):
    path = write_ply(tmp_path / "empty.ply", np.zeros((0, 3)))
    with pytest.raises(UserError, match="empty|no points"):
        GaussianCloud({"prior_type": "point-cloud-prior", "prior": {"path": str(path)}}).initialize(
            "a prompt"
        )
    measured("points: named error")


def corrupted(values: np.ndarray, share: float) -> np.ndarray:
    """Set a share of the rows to NaN or infinity, in one of the columns."""
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
    """1 % of 642 is 6. If the faces must be kept, a vertex without a colour becomes grey; otherwise
    its point is dropped.
    """
    prior_type, write = SOURCES[source]
    points, faces = ball_mesh()
    arrays = {"vertices": points, "colours": rng().random(points.shape)}

    def initialized(share: float) -> GaussianCloud:
        path = write(tmp_path, *(arrays | {what: corrupted(arrays[what], share)}).values(), faces)
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
@pytest.mark.parametrize("source", ["mesh", "points", "ply"])
def test_without_colours_the_cloud_is_grey_with_a_message(source, tmp_path, measured, said):
    points, faces = ball_mesh()
    if source == "mesh":
        prior = {
            "prior_type": "mesh-prior",
            "prior": {"path": str(write_obj(tmp_path / "a.obj", points, faces))},
        }
    else:
        path = tmp_path / ("a.xyz" if source == "points" else "a.ply")
        if source == "points":
            np.savetxt(path, points)
        else:
            trimesh.PointCloud(points).export(path)
        prior = {"prior_type": "point-cloud-prior", "prior": {"path": str(path)}}
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
