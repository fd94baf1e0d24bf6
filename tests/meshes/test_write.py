"""Textured meshes are written so that other programs read them: upright, closed, in sRGB."""

import json
import struct

import numpy as np
import pytest
import trimesh

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import Mesh, surface_colors
from threestudio_gaussiandreamer.meshes.write import welded, write_textured_mesh
from threestudio_gaussiandreamer.surface.bake import in_grid


def textured_box():
    """Return a closed box, y up, taller than wide, whose top is red and whose rest is grey."""
    box = trimesh.creation.box((1, 2, 1.5))
    atlas = in_grid(box.vertices, box.faces, 64)
    mesh = Mesh(box.vertices[atlas.rows], atlas.faces, uv=atlas.uv)
    texture = np.full((64, 64, 3), 128, np.uint8)
    for corners in mesh.faces[(mesh.vertices[mesh.faces][..., 1] > 0.99).all(axis=1)]:
        columns, rows = (mesh.uv[corners] * [64, -64] + [0, 64]).T
        box_of = [slice(int(x.min()) - 1, int(np.ceil(x.max())) + 1) for x in (rows, columns)]
        texture[tuple(slice(max(s.start, 0), s.stop) for s in box_of)] = [200, 30, 20]
    return mesh._replace(texture=texture)


MESH = textured_box()


def document(path):
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON") and size % 4 == 0
    return json.loads(data[20 : 20 + length])


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_others_and_we_read_a_closed_upright_mesh_of_the_same_colours(suffix, tmp_path):
    path = tmp_path / f"box{suffix}"
    write_textured_mesh(path, MESH)
    read = trimesh.load(path, force="mesh")
    np.testing.assert_allclose(read.extents, [1, 2, 1.5], atol=1e-6)
    material = read.visual.material
    picture = getattr(material, "image", None) or material.baseColorTexture
    np.testing.assert_array_equal(np.asarray(picture), MESH.texture)
    read.merge_vertices(merge_tex=True, merge_norm=True)
    assert read.is_watertight and read.volume == pytest.approx(3)
    ours = load_mesh(path)
    face = np.arange(len(ours.faces))
    up = ours.vertices[ours.faces].mean(axis=1)[:, 2] > 0.99  # y of the file is our z
    colors = surface_colors(ours, face, np.full((len(face), 3), 1 / 3)) * 255
    np.testing.assert_allclose(colors[up], [[200, 30, 20]] * up.sum(), atol=1)
    assert up.sum() == 2
    with pytest.raises(UserError, match="cannot write .*nowhere"):
        write_textured_mesh(tmp_path / "nowhere" / f"box{suffix}", MESH)
    broken = MESH._replace(vertices=np.where(MESH.vertices > 0.9, np.nan, MESH.vertices))
    refused("NaN or infinity", write_textured_mesh, tmp_path / f"broken{suffix}", broken)
    assert not list(tmp_path.glob("broken*"))
    refused(r"\.glb or \.obj", write_textured_mesh, tmp_path / "box.fbx", MESH)


@pytest.mark.parametrize(
    ("file", "given", "name"),
    [
        ("a red fox", "", "a_red_fox"),
        ("mesh", "a DSLR photo of\na 狐", "a_DSLR_photo_of_a_狐"),
        ("grün", "x" * 80, "x" * 63),
    ],
)
def test_everything_has_the_name_of_the_asset(file, given, name, tmp_path):
    """Blender and others show these names; trimesh calls what has none geometry_0."""
    for suffix in (".glb", ".obj"):
        write_textured_mesh(tmp_path / f"{file}{suffix}", MESH, name=given)
        scene = trimesh.load_scene(tmp_path / f"{file}{suffix}")
        (geometry,) = scene.geometry.values()
        assert geometry.visual.uv is not None
        if suffix == ".glb":  # of an OBJ trimesh 4.6 has names of its own
            assert geometry.visual.material.name == name
            assert list(scene.geometry) == list(scene.graph.nodes_geometry) == [name]
    kinds = ("nodes", "meshes", "materials", "textures", "images")
    found = document(tmp_path / f"{file}.glb")
    assert [found[kind][0]["name"] for kind in kinds] == [name] * 5
    library, named, used, *_ = (tmp_path / f"{file}.obj").read_text("utf-8").splitlines()
    assert (library.count(" "), named, used) == (1, f"o {name}", f"usemtl {name}")
    assert load_mesh(tmp_path / f"{file}.obj").texture.shape == (64, 64, 3)


@pytest.mark.parametrize("unlit", [False, True])
def test_the_material_is_rough_and_not_metallic(unlit, tmp_path):
    write_textured_mesh(tmp_path / "box.glb", MESH, unlit=unlit)
    found = document(tmp_path / "box.glb")
    material = found["materials"][0]["pbrMetallicRoughness"]
    assert (material["metallicFactor"], material["roughnessFactor"]) == (0, 1)
    assert ("KHR_materials_unlit" in found.get("extensionsUsed", ())) == unlit
    assert ("extensions" in found["materials"][0]) == unlit


def test_an_obj_names_its_files_and_every_position_once_and_normals_point_outwards(tmp_path):
    write_textured_mesh(tmp_path / "box.obj", MESH)
    lines = (tmp_path / "box.obj").read_text().splitlines()
    assert lines[0] == "mtllib box.mtl" and sum(line.startswith("v ") for line in lines) == 8
    assert "map_Kd box.png" in (tmp_path / "box.mtl").read_text().splitlines()
    joined = welded(MESH)
    assert len(joined.positions) == 8
    np.testing.assert_allclose(np.linalg.norm(joined.normals, axis=1), 1)
    assert ((joined.normals * joined.positions).sum(axis=1) > 0).all()
