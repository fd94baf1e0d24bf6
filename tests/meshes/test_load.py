"""Meshes of all formats: their pose, their colours, and files that are refused."""

import contextlib
import os
import time

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes.load import AXES, find_mesh, load_mesh
from threestudio_gaussiandreamer.meshes.mesh import (
    Mesh,
    SurfaceDistance,
    merged,
    sample_surface,
    surface_colors,
)

THIRDS = np.full((1, 3), 1 / 3)


def box(extents=(1, 1, 1), center=(0, 0, 0)):
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(center)
    return mesh


def saved(mesh, path):
    mesh.export(path)
    return path


def center_color(mesh, face=0):
    return surface_colors(mesh, np.array([face]), THIRDS)[0]


def test_a_scene_is_merged_centred_scaled_and_turned_to_its_axes(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(box(), transform=trimesh.transformations.translation_matrix([0, 0, 3]))
    scene.add_geometry(box())
    mesh = load_mesh(saved(scene, tmp_path / "scene.glb"))
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [2, 0.5, 0.5], atol=1e-6)
    for unit in (1, 1e3):
        made = box((2 * unit, 5 * unit, unit), (100 * unit, -3, 7))
        mesh = load_mesh(saved(made, tmp_path / "box.stl"), scale=1.5)
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        np.testing.assert_allclose(high, [0.6, 1.5, 0.3], atol=2e-6)  # STL holds float32
        np.testing.assert_allclose(low, -high, atol=1e-6)
    arrow = trimesh.Trimesh(np.diag([3.0, 2, 1]), [[0, 1, 2]])
    for name in ("a.glb", "a.obj", "a.off", "a.ply"):
        path = saved(arrow, tmp_path / name)
        axes = ("+y", "+z") if name in ("a.glb", "a.obj") else ("+z", "+x")
        given = load_mesh(path, up=axes[0], front=axes[1])
        np.testing.assert_array_equal(load_mesh(path).vertices, given.vertices)
    for up, front in (("+y", "-x"), ("-z", "+y"), ("+x", None), ("-y", "+z")):
        mesh = load_mesh(path, up=up, front=front)
        front = front or "+y"  # the axis after x
        turn = np.stack([AXES[front], np.cross(AXES[up], AXES[front]), AXES[up]])
        np.testing.assert_allclose(mesh.vertices, given.vertices @ turn.T, atol=1e-12)
        assert np.isclose(np.linalg.det(turn), 1)
    wrong = ("z", None, "up axis"), ("auto", "+w", "front axis"), ("+z", "-z", "along")
    for up, front, said in wrong:
        refused(said, load_mesh, path, up=up, front=front)


def test_colours_of_vertices_faces_and_materials(tmp_path):
    mesh = load_mesh(saved(box(), tmp_path / "plain.glb"))
    assert not mesh.has_colors
    np.testing.assert_array_equal(center_color(mesh), 0.5)
    colors = np.eye(3, 4) * 255 + [0, 0, 0, 255]
    corners, faces = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]
    source = trimesh.Trimesh(corners, faces, vertex_colors=colors)
    mesh, weights = load_mesh(saved(source, tmp_path / "a.ply")), np.array([[0.2, 0.3, 0.5]])
    np.testing.assert_allclose(surface_colors(mesh, np.array([0]), weights), weights, atol=1e-6)
    source = box()
    source.visual.face_colors = np.random.default_rng(0).integers(0, 255, (12, 4))
    mesh = load_mesh(saved(source, tmp_path / "a.ply"))
    expected = source.visual.face_colors[:, :3] / 255
    found = [center_color(mesh, face) for face in range(12)]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    material = PBRMaterial(baseColorFactor=[255, 0, 55, 255])
    source.visual = trimesh.visual.TextureVisuals(material=material)
    mesh = load_mesh(saved(source, tmp_path / "a.glb"))  # its colour is linear
    expected = [1, 0, 1.055 * (55 / 255) ** (1 / 2.4) - 0.055]
    np.testing.assert_allclose(center_color(mesh), expected, atol=1e-6)
    white = Image.new("RGB", (2, 2), "white")
    for tint, seen in ([255, 0, 255, 255], [1, 0, 1]), ([102, 102, 102, 255], 1):
        # the second is trimesh's "no colour given"
        material = PBRMaterial(baseColorTexture=white, baseColorFactor=tint)
        visual = trimesh.visual.TextureVisuals(uv=np.eye(3, 2), material=material)
        triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], visual=visual, process=False)
        found = center_color(load_mesh(saved(triangle, tmp_path / "a.glb")))
        np.testing.assert_allclose(found, seen, atol=1e-6)


def test_a_merged_scene_has_the_colours_of_its_parts_and_texels_are_bilinear():
    """Two textures of other sizes, one repeating, colours of vertices, of faces, and none."""
    rng = np.random.default_rng(0)
    corners = np.float64([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    plain, uv = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), corners[:, :2].astype(np.float32)
    pictures = [rng.integers(0, 256, (*size, 3), np.uint8) for size in ((3, 5), (1, 2))]
    parts = [plain._replace(uv=uv, texture=pictures[0])]
    parts += [plain._replace(uv=4 * uv, texture=pictures[1], vertex_colors=rng.random((4, 3)))]
    parts += [plain._replace(vertex_colors=rng.random((4, 3))), plain]
    parts += [plain._replace(face_colors=rng.random((2, 3)))]
    weights, faces = rng.dirichlet([1] * 3, 10), np.arange(10)
    rows = [slice(2 * i, 2 * i + 2) for i in range(5)]
    expected = [surface_colors(x, faces[:2], weights[r]) for x, r in zip(parts, rows, strict=True)]
    mesh = merged(parts)
    assert len(mesh.tiles) == 2
    found = surface_colors(mesh, faces, weights)
    np.testing.assert_allclose(found, np.concatenate(expected), atol=1e-6)
    image = [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]]
    places = np.float32([[0.25, 0.75], [0.5, 0.75], [0.75, 0.25], [1.25, -0.25], [0.0, 0.75]])
    uv, faces = np.repeat(places, 3, axis=0), np.arange(15).reshape(5, 3)
    mesh = Mesh(np.zeros((15, 3)), faces, uv=uv, texture=np.array(image, np.uint8))
    expected = [[1, 0, 0], [0.5, 0.5, 0], [1, 1, 1], [1, 0, 0], [0.5, 0.5, 0]]
    found = surface_colors(mesh, np.arange(5), np.full((5, 3), 1 / 3))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_surface_distances_of_a_sphere(tmp_path):
    mesh = load_mesh(saved(trimesh.creation.icosphere(4), tmp_path / "a.ply"))
    points = np.array([[1.5, 0, 0], [0, 0, 0], [0, 1.0, 0]])
    # spacing of 2e5 samples on a sphere is 0.008; the icosphere's faces lie up to 0.002 inside
    np.testing.assert_allclose(SurfaceDistance(mesh)(points), [0.5, 1.0, 0.0], atol=0.012)


def test_objects_and_stl_files_as_programs_write_them_are_read(tmp_path):
    """Blanks, tabs, carriage returns, continued lines, exponents, colours, polygons."""
    text = (
        "# made by hand\r\nmtllib none.mtl\no box\nv 0 0.0 -.0 1 0 0\nv  1e0\t0 0 0 1 0 \nv 1 "
        "1.5E-0 0 0 0 1\nv +0 1 0 1 1 1\n"
        "vt 0 0 0\nvt 1 0 0\nvt 1 1 0\nvt 0 1 0\nvn 0 0 1\ng a b\ns off\nusemtl m\nf 1/1/1 "
        "2/2/1 \\\n3/3/1 4/4/1\nvp 1 2\nl 1 2\n"
    )
    (tmp_path / "a.obj").write_bytes(text.encode())
    assert len(load_mesh(tmp_path / "a.obj").faces) == 2
    text = "  v\t0 0 0\nv 1 0 0\nV 0 1 0\nf -3 -2 -1\n\tF 1//1 2//1 3//1\nvn 0 0 1\n"
    (tmp_path / "b.obj").write_text(text)
    assert len(load_mesh(tmp_path / "b.obj").faces) == 2
    # faces count backwards from vertices that others follow, as generators write parts
    first, second = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n", "v 0 0 1\nv 1 0 1\nvt 1 1\n"
    backwards, absolute = ("-3/-1/-1 -2/-1 -1", "-2/-1 2 -4"), ("1/1/1 2/1 3", "4/2 2 2")
    found = []
    for one, two in (backwards, absolute):
        (tmp_path / "a.obj").write_text(f"{first}f {one}\n{second}f {two}\n")
        found.append(load_mesh(tmp_path / "a.obj"))
    np.testing.assert_array_equal(found[0].vertices, found[1].vertices)
    np.testing.assert_array_equal(found[0].faces, found[1].faces)
    triangle = np.array([0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0], "<f4").tobytes() + b"\0\0"
    for header in (bytes(80), b"solid base".ljust(80, b"\0")):
        (tmp_path / "a.stl").write_bytes(header + b"\1\0\0\0" + triangle + bytes(30))
        assert len(load_mesh(tmp_path / "a.stl").faces) == 1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.glb", None, "does not exist"),
        ("a.xlsx", b"x", "unknown mesh format"),
        ("noise.glb", b"not a glb at all" * 9, "isn't a GLB file, which begins with glTF"),
        ("empty.glb", b"", "isn't a GLB file, which begins with glTF"),
        ("page.glb", b"<!doctype html>", "is a web page, not the file itself"),
        ("flat.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "zero area"),
        ("zero.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 2 3\n", "line 4 is no vertex or face: 'f"),
        ("word.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf x 2 3\n", "line 5 is no .*: 'f x"),
        ("word.obj", b"v 0 0 0\nv 1_0 0 0\nv 0 1 0\nf 1 2 3\n", "line 2 is no .*: 'v 1_0"),
        ("two.obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "line 1 is no vertex or face"),
        ("back.obj", b"v 0 0 0\nv 1 0 0\nf -3 -2 -1\nv 0 0 1\n", "names number -3 of 2 vertices"),
        ("cut.stl", bytes(80) + b"\2\0\0\0" + bytes(60), "184 bytes were expected, not 144"),
        ("a.gltf", b'{"asset": {"version": "2.0"}, "scenes": [{}]}', "no faces"),
        ("list.gltf", b"[]", "damaged"),
        ("chunk.glb", b"glTF\2\0\0\0\x20\0\0\0\xff\xff\xff\x7fJSON{}", "chunks"),
        ("range.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "damaged"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    refused(message, load_mesh, tmp_path / name)


@pytest.mark.parametrize("line", ["v 0 0 1%sx", "f 1 2 %sx", "f" + " 0/1/1" * 9000 + "%sx"])
def test_a_long_line_takes_linear_time(tmp_path, line):
    (tmp_path / "a.obj").write_text("v 0 0 0\n" + line % ("1" * 64_000) + "\n")
    started = time.process_time()
    refused("a.obj", load_mesh, tmp_path / "a.obj")
    assert time.process_time() - started < 2  # a quadratic search takes minutes


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
def test_other_colours_of_an_off_file(tmp_path, caplog, head, of_vertices, of_faces, warned):
    vertices = "".join(f"{corner}{of_vertices}\n" for corner in CORNERS)
    faces = OFF_FACES.replace("\n", f"{of_faces}\n")
    (tmp_path / "a.off").write_text(f"{head}\n4 4 6\n{vertices}{faces}")
    assert not load_mesh(tmp_path / "a.off").has_colors
    found = f"colours of its {warned} aren't read" in caplog.text
    assert found if warned else "colours" not in caplog.text


def test_the_bundled_toy_is_found_by_its_name_and_faces_the_front(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_mesh("toy.glb").stat().st_size < 400_000
    mesh = load_mesh("toy.glb")
    points, *where = sample_surface(mesh, 20000, np.random.default_rng(0))
    red, green, blue = surface_colors(mesh, *where).T
    nose = (red < 0.2) & (green < 0.2) & (points[:, 0] > 0)
    assert nose.sum() > 50 and points[nose, 0].mean() > 0.4 and points[nose, 2].mean() > 0.2
    tail = (points[:, 1] > 0.5) & (np.minimum(np.minimum(red, green), blue) > 0.7)
    assert tail.sum() > 100  # its pale tip is on the left
    saved(box(), tmp_path / "toy.glb")
    assert len(load_mesh("toy.glb").faces) == 12  # a file of that name comes first


def test_what_prevents_reading_is_named(tmp_path, monkeypatch):
    """A package of trimesh's that isn't installed, too little memory, a refused side file."""

    def load(*args, resolver, **options):
        with contextlib.suppress(OSError, ValueError):  # as trimesh's readers
            resolver.get("fifo.png")
        raise error

    monkeypatch.setattr(trimesh, "load_scene", load)
    path = saved(box(), tmp_path / "a.off")
    for error in (ImportError("No module named 'collada'"), MemoryError("collada")):
        expected = MemoryError if type(error) is MemoryError else UserError
        with pytest.raises(expected, match="collada") as caught:
            load_mesh(path)
        assert "damaged" not in str(caught.value)
    os.mkfifo(tmp_path / "fifo.png")
    refused("fifo.png.* regular file", load_mesh, path)


def test_a_bundled_mesh_is_suggested_for_a_misspelt_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    saved(box(), tmp_path / "toys.glb")
    for name in ("toyy.glb", "to.glb", "Toy.glb", "nowhere/toy.glb"):
        of_folder = "there is no folder" if "/" in name else "near names in '.': toys.glb."
        said = rf"did you mean the bundled 'toy.glb'\? {of_folder}"
        refused(said, load_mesh, name)
