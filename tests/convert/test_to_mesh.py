"""``convert cloud.ply object.glb`` writes a textured mesh, the right way up."""

import numpy as np
import pytest

from tests.helpers.painted_ball import painted_ball
from threestudio_gaussiandreamer.convert.command import main
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import vertex_surface_colors

SMALL = "--faces 300 --texture 96 --views 24 --view-size 96 --resolution 24".split()


@pytest.mark.parametrize("name", ["ball.glb", "ball.obj"])
def test_the_mesh_stands_upright_with_its_front_forward(name, tmp_path, capsys):
    write_cloud(str(tmp_path / "ball.ply"), StoredCloud(painted_ball(300)).in_axes("-y"))
    assert main([str(tmp_path / "ball.ply"), str(tmp_path / name), *SMALL]) == 0
    assert "triangles, a texture of 96 x 96" in capsys.readouterr().out
    mesh = load_mesh(tmp_path / name)  # in our axes, by glTF's: y up, front +z
    colors = vertex_surface_colors(mesh)
    directions = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    # red in front, green on the left, blue on top, as the ball is painted
    assert np.abs(colors - (0.5 + 0.4 * directions)).mean() < 0.05


def test_an_obj_that_cannot_have_its_texture_beside_it_is_refused(tmp_path, capsys):
    write_cloud(str(tmp_path / "ball.ply"), StoredCloud(painted_ball(50)))
    (tmp_path / "ball.png").mkdir()
    assert main([str(tmp_path / "ball.ply"), str(tmp_path / "ball.obj"), *SMALL]) == 2
    assert "it is a folder" in capsys.readouterr().err and not (tmp_path / "ball.obj").exists()
