"""The first cloud doesn't depend on the unit and position of the prior's points."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import scipy.spatial
import scipy.stats
import torch

from tests.stability import initialisation_cases as cases
from tests.stability.rows import row
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.gaussians.grow import (
    grow,
    longest_side,
)
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import face_areas, sample_surface
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.initialization import grow_points

register_parts()


CUBE = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


# ---- unit and place ------------------------------------------------------------------------------


def initialized_from(path: Path) -> tuple[GaussianCloud, int]:
    """Return the first cloud of a file in the world's frame, and the number of grown points."""
    prior = (
        {"normalize": True} if path.suffix == ".npz" else {"num_points": 2000, "color": "random"}
    )  # a grey cloud on grey is invisible
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
    np.savez(path, points=points, colors=cases.rng().random(points.shape))
    return path


@row("A2", "Units and pose")
@pytest.mark.parametrize("kind", ["obj", "npz"])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_neither_unit_nor_place_matters(unit, kind, tmp_path, measured):
    """Millimetres, metres, kilometres, each at its place and 10 000 units away."""
    points, faces = cases.ball_mesh()
    write = (
        write_npz if kind == "npz" else lambda path, points: cases.write_obj(path, points, faces)
    )
    (tmp_path / "b").mkdir()
    usual, expected = initialized_from(write(tmp_path / f"a.{kind}", points))
    for shift in (0.0, 1e4):
        other, count = initialized_from(write(tmp_path / f"b/a.{kind}", points * unit + shift))
        measured(
            abs(count / expected - 1) * 100,
            "%",
            what="deviation of the accepted share",
            at_most=1.0,
        )
        n = min(len(usual), len(other))
        assert torch.allclose(other.means[:n], usual.means[:n], atol=1e-4)
        measured(
            psnr(cases.picture(other, usual), cases.picture(usual)).min(),
            "dB",
            what="PSNR after normalisation",
            at_least=50.0,
        )


@row("A2", "Units and pose")
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_growing_does_not_depend_on_the_unit(unit, shift, measured):
    options = {"num_candidates": 20_000, "radius": 0.05}
    cloud = cases.colored(cases.sphere())
    counts = [
        len(grow(cloud._replace(points=points), **options, generator=cases.rng()).points)
        for points in (cases.sphere(), cases.sphere() * unit + shift)
    ]
    measured(
        abs((counts[1] - 1000) / (counts[0] - 1000) - 1) * 100,
        "%",
        what="deviation of the accepted share",
        at_most=1.0,
    )


# ---- degenerate shapes ---------------------------------------------------------------------------


@row("A2", "Flat, needle, point bbox")
@pytest.mark.parametrize("axes", [(0, 1), (2,), ()], ids=["plane", "line", "point"])
def test_a_flat_prior_grows_a_slab_within_the_caps(axes, measured):
    points = np.full((500, 3), 0.25)
    points[:, axes] = cases.rng().uniform(-1, 1, (500, len(axes)))
    reach = 0.05 * (longest_side(points) or 1.0)
    flat = [axis for axis in range(3) if axis not in axes]
    options = {"num_candidates": 50_000, "radius": 0.05, "max_points": 2000}
    geometry = cases.started(cases.colored(points), grow={"enabled": True, **options})
    measured(len(geometry) - 500, "grown, of at most 2000", at_most=2000)
    offsets = (geometry.means[500:, flat] - 0.25).abs().detach()
    assert (
        offsets.max() <= 1.0001 * reach and (offsets.amax(0) > 0.9 * reach).all()
    )  # it fills the slab only
    assert cases.picture(geometry).isfinite().all() and geometry.log_scales.isfinite().all()
    assert (
        len(
            cases.started(
                cases.colored(points), grow={"enabled": True, **options}, max_gaussians=700
            )
        )
        == 700
    )


@row("A2", "No grown point")
def test_a_cube_without_grown_points(measured):
    geometry = cases.started(
        cases.colored(CUBE), grow={"enabled": True, "num_candidates": 100_000, "radius": 0.0025}
    )
    assert torch.equal(geometry.means, torch.from_numpy(CUBE).float())
    assert torch.allclose(geometry.colors(torch.zeros(1, 3)), torch.tensor(0.5))
    assert cases.picture(geometry).isfinite().all()
    measured(len(geometry), "Gaussians, the vertices", at_most=8)


def uneven_square() -> tuple[np.ndarray, np.ndarray]:
    """Return a square of 162 triangles of very different sizes, and a tenth more without area."""
    ticks = np.concatenate([[0.0], np.sort(cases.rng(3).random(8)) ** 2, [1.0]])
    points = np.array([(x, y, 0.0) for x in ticks for y in ticks])
    corner = (10 * np.arange(9)[:, None] + np.arange(9)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 10, 1], corner + [10, 11, 1]])
    without_area = np.concatenate([corner[::9] + [0, 1, 2], corner[1::9] + [0, 0, 1]])
    return points, np.concatenate([faces, without_area])


def uniformity(points: np.ndarray) -> float:
    """Return the smaller p of the Kolmogorov-Smirnov tests that both coordinates are uniform on
    [-1, 1].
    """
    return min(scipy.stats.kstest(axis, "uniform", (-1, 2)).pvalue for axis in points.T[:2])


@row("A2", "Non-manifold, duplicate faces, degenerate triangles")
@pytest.mark.parametrize("repeated", ["not", "same", "reversed", "with copied vertices"])
def test_a_surface_is_sampled_uniformly_for_any_triangulation(repeated, tmp_path, measured):
    """Repeated faces, whose edges are non-manifold, are on one side: counted twice, that side would
    be denser.
    """
    points, faces = uneven_square()
    again = faces[:40] if repeated != "reversed" else faces[:40, ::-1]
    if repeated == "with copied vertices":
        again, points = again + len(points), np.concatenate([points, points])
    faces = faces if repeated == "not" else np.concatenate([faces, again])
    mesh = load_mesh(cases.write_ply(tmp_path / "square.ply", points, faces=faces))
    sampled, face_index, _ = sample_surface(mesh, 5000, cases.rng())
    assert (face_areas(mesh) == 0).sum() >= 18 and (face_areas(mesh)[face_index] > 0).all()
    measured(uniformity(sampled), what="p of the worse axis", at_least=0.01)
    if repeated != "not":
        twice = cases.rng().choice(
            len(mesh.faces), 5000, p=face_areas(mesh) / face_areas(mesh).sum()
        )
        assert (
            uniformity(mesh.vertices[mesh.faces[twice]].mean(1)) < 0.01
        )  # the test detects a density that is off


@row("A2", "Colour perturbation")
@pytest.mark.parametrize(
    "color_range, mean", [((0.0, 0.2), 0.1), ((-0.1, 0.1), 0.0)], ids=["the paper's", "zero mean"]
)
def test_noise_stays_in_its_range_and_colours_in_theirs(color_range, mean, measured):
    """Middle grey shows the noise itself, whose histogram is flat to 5 standard errors; nearly
    white shows the clamp.
    """
    options = {
        "enabled": True,
        "num_candidates": 40_000,
        "radius": 0.05,
        "color_range": list(color_range),
    }

    def grown(color: float, **more) -> np.ndarray:
        return grow_points(
            cases.colored(cases.sphere(), color), GaussianCloud({"grow": options | more}).cfg.grow
        ).colors[1000:]

    noise = grown(0.5) - 0.5
    counts, expected = np.histogram(noise, 10, color_range)[0], noise.size / 10
    assert counts.sum() >= noise.size - 2 and np.abs(counts - expected).max() < 5 * np.sqrt(
        expected
    )  # 2: rounding at the ends
    measured(abs(noise.mean() - mean), what=f"mean of the noise off {mean:g}", at_most=0.003)
    measured(grown(0.95).max(), what="brightest", at_most=1.0)
    assert grown(0.05).min() >= 0.0 and grown(0.95, clamp=False).max() > 1.03
