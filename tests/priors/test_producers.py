"""Files in the conventions of other generators become priors that stand upright, face +x, have the
size of ``scale`` and display colours."""

import numpy as np
import pytest
import trimesh

from tests.formats.test_producers import EXPORTS
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.formats.producers import GAUSSIANS
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import C0
from threestudio_gaussiandreamer.host import find

register_parts()
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


def in_world(mesh):
    """Return the vertices as a prior has to give them."""
    vertices = mesh.vertices - (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return SCALE * vertices / (np.ptp(vertices, axis=0).max() / 2)


def matched(points, colors, wanted_colors):
    """Order the rows by their colours, which are all different."""
    order = [np.abs(colors - color).sum(axis=1).argmin() for color in wanted_colors]
    return points[order], colors[order]


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
    wanted = in_world(mesh)
    for part in ("gaussians-prior" if kind == GAUSSIANS else "mesh-prior", "point-cloud-prior"):
        cloud = find(part)({"path": str(path), "producer": name, "scale": SCALE})("")
        points, found = matched(cloud.points, cloud.colors, colors / 255)
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
