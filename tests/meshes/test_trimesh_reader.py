"""What trimesh doesn't read: colours of OFF files."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.meshes.load import load_mesh

OFF_FACES = "3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
CORNERS = ("0 0 0", "1 0 0", "0 1 0", "0 0 1")


@pytest.mark.parametrize(
    ("head", "colors"),
    [
        ("COFF\n4 4 6\n", ["255 0 0 255", "0 255 0 255", "0 0 255 255", "51 51 51 0"]),
        ("OFF 4 4 6 # a comment\n\n", ["1.0 0 0", "0 1.0 0", "0 0 1.0", "0.2 0.2 0.2"]),
        ("\ufeffCOFF\n4 4 6\n", ["1 0 0 1", "0 1 0 1", "0 0 1 1", "0.2 0.2 0.2 1"]),
    ],
)
def test_colours_of_an_off_files_vertices(tmp_path, head, colors):
    path = tmp_path / "a.off"
    rows = [f"{corner} {color}\n" for corner, color in zip(CORNERS, colors, strict=True)]
    path.write_text(head + "".join(rows) + OFF_FACES)
    mesh = load_mesh(path)
    expected = np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 0.2]])
    np.testing.assert_allclose(mesh.vertex_colors, expected, atol=1e-3)


@pytest.mark.parametrize(
    ("head", "of_vertices", "of_faces", "warned"),
    [
        ("OFF", "", " 255 0 0", "faces"),
        ("OFF", "", "", None),
        ("NOFF", " 0 0 1", "", None),
        ("CNOFF", " 0 0 1 255 0 0", "", "vertices"),
        ("COFF", " 1 0 red", "", "vertices"),
        ("COFF", " nan 0 0 1", "", "vertices"),
    ],
)
def test_other_colours_of_an_off_file_are_reported(
    tmp_path, caplog, head, of_vertices, of_faces, warned
):
    path = tmp_path / "a.off"
    vertices = "".join(f"{corner}{of_vertices}\n" for corner in CORNERS)
    path.write_text(f"{head}\n4 4 6\n" + vertices + OFF_FACES.replace("\n", f"{of_faces}\n"))
    assert not load_mesh(path).has_colors
    found = f"colours of its {warned} aren't read" in caplog.text
    assert found if warned else "colours" not in caplog.text
