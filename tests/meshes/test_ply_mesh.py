"""PLY meshes: polygons, colours and textures as Blender, MeshLab and others write them."""

import struct

import numpy as np
import pytest
from PIL import Image

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.meshes.load import load_mesh, read_parts
from threestudio_gaussiandreamer.meshes.mesh import vertex_surface_colors

SQUARE = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
UV = np.float32([[0.25, 0.75], [0.75, 0.75], [0.75, 0.25], [0.25, 0.25]])
TEXELS = np.uint8([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]])
EXPECTED = np.float32([[1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1]])
TRIANGLES, MIXED = [[0, 1, 2], [0, 2, 3]], [[0, 1, 2], [0, 1, 2, 3]]
TEXTURE = ["comment TextureFile t.png"]
"""Coordinates of the middles of four texels, whose row 0 is at the top, and their colours."""


def ply(folder, *, faces, columns=(), corners=None, comments=(), binary=True, more=()):
    """Write a square: ``columns`` (name, type, code, values) of vertices, ``more`` of faces."""
    Image.fromarray(TEXELS).save(folder / "t.png")
    columns = [(axis, "float", "f", SQUARE[:, i]) for i, axis in enumerate("xyz")] + [*columns]
    head = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", *comments]
    head += [f"element vertex {len(SQUARE)}", *(f"property {c[1]} {c[0]}" for c in columns)]
    head += [f"element face {len(faces)}", "property list uchar uint vertex_indices"]
    head += ["property list uchar float texcoord"] * (corners is not None)
    head += [f"property {kind} {name}" for name, kind, _, _ in more]
    rows = [[(c[2], c[3][i]) for c in columns] for i in range(len(SQUARE))]
    for i, face in enumerate(faces):
        row = [("B", len(face)), *(("I", corner) for corner in face)]
        if corners is not None:
            flat = corners[face].ravel()
            row += [("B", len(flat)), *(("f", value) for value in flat)]
        rows.append(row + [(code, values[i]) for _, _, code, values in more])
    pack = {
        True: lambda row: b"".join(struct.pack(f"<{code}", value) for code, value in row),
        False: lambda row: " ".join(f"{value}" for _, value in row).encode() + b"\n",
    }
    text = "\n".join([*head, "end_header"]).encode() + b"\n"
    (folder / "a.ply").write_bytes(text + b"".join(map(pack[binary], rows)))
    return folder / "a.ply"


def of_vertices(names=("s", "t"), values=UV):
    return [(name, "float", "f", values[:, i]) for i, name in enumerate(names)]


def colors_at_corners(path):
    """Colours by position, of the square's corners in their order."""
    (part,) = read_parts(path)
    found = dict(zip(map(tuple, part.vertices), vertex_surface_colors(part), strict=True))
    return np.array([found[tuple(corner)] for corner in SQUARE.astype(float)])


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("faces", [TRIANGLES, MIXED, [[0, 1, 2, 3]]])
def test_texture_coordinates_of_vertices_and_corners(tmp_path, binary, faces):
    for names in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        columns = of_vertices(names)
        path = ply(tmp_path, faces=faces, columns=columns, comments=TEXTURE, binary=binary)
        np.testing.assert_array_equal(colors_at_corners(path), EXPECTED)
        assert len(read_parts(path)[0].faces) == {1: 2, 2: 2 + (faces is MIXED)}[len(faces)]
    path = ply(tmp_path, faces=faces, corners=UV, comments=TEXTURE, binary=binary)
    np.testing.assert_array_equal(colors_at_corners(path), EXPECTED)
    assert len(read_parts(path)[0].vertices) == 4
    path = ply(tmp_path, faces=[[0, 1, 2]], corners=UV, comments=TEXTURE, binary=binary)
    mesh = load_mesh(path)
    assert mesh.faces.shape == (1, 3) and mesh.texture is not None


def test_seams_several_textures_and_the_digits_of_doubles(tmp_path):
    corners = ply(tmp_path, faces=TRIANGLES, corners=UV, comments=TEXTURE).read_bytes()
    at = corners.rindex(UV[0].tobytes())
    moved = corners[:at] + np.float32([0.75, 0.25]).tobytes() + corners[at + 8 :]
    (tmp_path / "a.ply").write_bytes(moved)
    (part,) = read_parts(tmp_path / "a.ply")
    assert len(part.vertices) == 5  # those at the seam are divided
    Image.fromarray(TEXELS[::-1]).save(tmp_path / "other.png")
    comments = [*TEXTURE, "comment TextureFile other.png"]
    more = [("texnumber", "int", "i", [0, 1])]
    parts = read_parts(ply(tmp_path, faces=TRIANGLES, corners=UV, comments=comments, more=more))
    np.testing.assert_array_equal([part.texture[0, 0] for part in parts], TEXELS[:, 0])
    assert [len(part.faces) for part in parts] == [1, 1]
    far = [(axis, "double", "d", SQUARE[:, i] + 5e6) for i, axis in enumerate("xyz")]
    text = ply(tmp_path, faces=TRIANGLES, columns=far).read_bytes()
    for axis in "xyz":
        text = text.replace(f"property float {axis}".encode(), f"property float a{axis}".encode())
    (tmp_path / "a.ply").write_bytes(text)
    np.testing.assert_array_equal(read_parts(tmp_path / "a.ply")[0].vertices, SQUARE + 5e6)


@pytest.mark.parametrize("colored", [True, False])
def test_a_texture_without_a_name_is_reported(tmp_path, caplog, colored):
    """Blender writes coordinates, and colours where the mesh has any, but no name."""
    names = ("red", "green", "blue")
    colors = [(name, "uchar", "B", 255 * np.eye(4, 3, dtype=int)[:, i])
              for i, name in enumerate(names)]  # fmt: skip
    columns = of_vertices() + colors * colored
    found = colors_at_corners(ply(tmp_path, faces=TRIANGLES, columns=columns))
    assert "names no texture" in caplog.text and "comment TextureFile NAME.png" in caplog.text
    np.testing.assert_array_equal(found, np.eye(4, 3) if colored else np.full((4, 3), 0.5))


@pytest.mark.parametrize("faces", [TRIANGLES, MIXED])
def test_colours_of_faces(tmp_path, faces):
    colors = {"red": [255, 0], "green": [0, 51], "blue": [0, 0]}
    more = [(name, "uchar", "B", values) for name, values in colors.items()]
    (part,) = read_parts(ply(tmp_path, faces=faces, more=more))
    expected = np.float32([[1, 0, 0], [0, 0.2, 0]])
    np.testing.assert_allclose(part.face_colors, expected[[0] + [1] * (len(part.faces) - 1)])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text[:-1], "truncated"),
        (lambda text: text[:-14], "truncated"),
        (lambda text: text[:-4] + struct.pack("<I", 4), "a vertex beyond the last of 4"),
        (lambda text: text.replace(b"face 2", b"face 9999999"), "9999999 rows of .face."),
        (lambda text: text.replace(b"face 2", b"face 3"), "truncated"),
        (lambda text: text.replace(b"float z", b"float w"), "its vertices have no x, y, z"),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, said):
    path = ply(tmp_path, faces=TRIANGLES)
    path.write_bytes(change(path.read_bytes()))
    refused(said, load_mesh, path)
