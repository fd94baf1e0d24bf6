"""Generated glTF files with one feature each: positions and colours are those of the standard."""

import functools
import operator
import zlib

import numpy as np
import pytest

from tests.helpers.gltf_builder import (
    BLUE,
    FOUR,
    GREEN,
    NEAREST,
    QUAD,
    QUAD_UV,
    RED,
    WHITE,
    Gltf,
    color_at,
    png,
    textured_quad,
)
from tests.helpers.memory import memory_below
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes import side_files as budget
from threestudio_gaussiandreamer.meshes.gltf import read_gltf
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import surface_colors
from threestudio_gaussiandreamer.priors.point_cloud import PointCloudPrior


@pytest.fixture
def saved(tmp_path):
    def save(made):
        (tmp_path / "a.glb").write_bytes(made.glb())
        return tmp_path / "a.glb"

    return save


def test_a_picture_is_upright_of_the_named_coordinates_and_tinted(saved):
    path = saved(textured_quad(FOUR, sampler=NEAREST))
    for place, color in (((0.2, 0.8), RED), ((0.8, 0.8), GREEN), ((0.2, 0.2), BLUE)):
        np.testing.assert_allclose(color_at(path, *place), color / 255)
    attributes = {"TEXCOORD_0": np.full((4, 2), 0.9, np.float32), "TEXCOORD_1": QUAD_UV}
    moved = {"texCoord": 0, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    for info in ({"texCoord": 1}, moved):
        path = saved(textured_quad(FOUR, sampler=NEAREST, info=info, attributes=attributes))
        np.testing.assert_allclose(color_at(path, 0.2, 0.8), RED / 255)
    grey = np.uint16([[0x4040, 0xFFFF], [0, 0x8080]])
    (part,) = read_gltf(saved(textured_quad(grey)))
    np.testing.assert_array_equal(part.texture[..., 0], [[0x40, 0xFF], [0, 0x80]])
    path = saved(textured_quad(FOUR, sampler=NEAREST, factor=[0.2158605, 1, 1, 1]))
    np.testing.assert_allclose(color_at(path, 0.2, 0.8), [128 / 255, 0, 0], atol=2e-3)  # sRGB


@pytest.mark.parametrize("kind", ["u1", "u2"])
def test_normalised_integers_are_fractions(kind, saved):
    most = np.iinfo(kind).max
    made = textured_quad(FOUR, sampler=NEAREST)
    uv = made.accessor((QUAD_UV * most).astype(kind), stride=4, normalized=True)
    colors = made.accessor(np.full((4, 4), most // 3, kind), normalized=True)
    attributes = made.document["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {"TEXCOORD_0": uv, "COLOR_0": colors}
    expected = np.array([1, 0, 0]) * (most // 3) / most
    np.testing.assert_allclose(color_at(saved(made), 0.2, 0.8), expected, atol=1e-6)


def test_quantised_positions_are_read(saved):
    """KHR_mesh_quantization: normalised signed integers, strided to four bytes."""
    made = Gltf(extensionsRequired=["KHR_mesh_quantization"])
    positions = made.accessor(np.int8([[-128, -127, 0], [127, 0, 64]] * 2), 4, normalized=True)
    made.primitive({"POSITION": positions}, indices=made.accessor(np.uint8([0, 1, 2])))
    (part,) = read_gltf(saved(made))
    np.testing.assert_allclose(part.vertices[:2], [[-1, -1, 0], [1, 0, 64 / 127]], atol=1e-7)


@pytest.mark.parametrize(
    "transform, uv",
    [
        ({"offset": [0.5, 0.0]}, [0.6, 0.2]),
        ({"scale": [0.5, 2.0]}, [0.05, 0.4]),
        ({"rotation": np.pi / 2}, [0.2, -0.1]),
        ({"rotation": np.pi / 6, "scale": [2, 3], "offset": [0.1, 0.2]}, None),
    ],
)
def test_texture_transforms(transform, uv, saved):
    """Scale, rotate counter-clockwise as the picture is seen (three.js, Blender), then move."""
    corner = np.float32([0.1, 0.2])
    if uv is None:
        c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
        uv = [c * 0.2 + s * 0.6 + 0.1, -s * 0.2 + c * 0.6 + 0.2]
    info = {"extensions": {"KHR_texture_transform": transform}}
    (part,) = read_gltf(saved(textured_quad(FOUR, uv=np.tile(corner, (4, 1)), info=info)))
    np.testing.assert_allclose(part.uv[0], [uv[0], 1 - uv[1]], atol=1e-6)


@pytest.mark.parametrize(
    "code, u, expected",
    [
        (10497, 1.25, RED),  # repeat: 0.25
        (10497, -0.25, GREEN),
        (33648, 1.25, GREEN),  # mirrored: 0.75
        (33648, -0.25, RED),
        (33648, 2.25, RED),
        (33071, 1.25, GREEN),  # clamped: the edge
        (33071, -3.0, RED),
    ],
)
def test_samplers_wrap_as_they_say(code, u, expected, saved):
    uv = np.tile(np.float32([u, 0.25]), (4, 1))
    sampler = {"wrapS": code, "wrapT": 33071} | NEAREST
    path = saved(textured_quad(FOUR, uv=uv, sampler=sampler))
    np.testing.assert_allclose(color_at(path, 0.5, 0.5), expected / 255)
    uv[:, 0] = 0  # only where it repeats, an edge is blended with the other one
    path = saved(textured_quad(FOUR, uv=uv, sampler={"wrapS": code, "wrapT": 33071}))
    edge = [0.5, 0.5, 0] if code == 10497 else RED / 255
    np.testing.assert_allclose(color_at(path, 0.5, 0.5), edge)


def test_wrapping_survives_a_merge_and_a_picture_is_kept_once(tmp_path):
    """Two quads with one image and different samplers, in the merged mesh that training uses."""
    uv = np.tile(np.float32([1.25, 0.25]), (4, 1))
    made = textured_quad(FOUR, uv=uv, sampler={"wrapS": 33071} | NEAREST)
    made.add("samplers", wrapS=33648, wrapT=33071, magFilter=9728)
    other = made.add("textures", source=0, sampler=1)
    primitive = dict(made.document["meshes"][0]["primitives"][0])
    primitive["material"] = made.material(other)
    made.document["meshes"][0]["primitives"].append(primitive)
    made.add("nodes", mesh=0, translation=[0, 0, 2])
    made.document["scenes"][0]["nodes"] = [0, 1]
    (tmp_path / "a.glb").write_bytes(made.glb())
    mesh = load_mesh(tmp_path / "a.glb")
    assert mesh.texture.size == 4 * 3 and len(mesh.tiles) == 2 and len(mesh.faces) == 8
    centers = surface_colors(mesh, np.arange(8), np.full((8, 3), 1 / 3))
    np.testing.assert_allclose(centers, np.array([GREEN, GREEN] * 4) / 255, atol=1e-6)


@pytest.mark.parametrize("base", [None, np.arange(12).reshape(4, 3)], ids=["zeros", "base"])
def test_sparse_accessors(base, saved):
    made, rows = Gltf(), [[5, 6, 7], [8, 9, 10]]
    positions = made.sparse(4, [1, 3], rows, base)
    made.primitive({"POSITION": positions}, indices=made.accessor(np.uint8([0, 1, 3])))
    expected = np.zeros((4, 3)) if base is None else base.copy()
    expected[[1, 3]] = rows
    np.testing.assert_array_equal(read_gltf(saved(made))[0].vertices, expected)


@pytest.mark.parametrize("where", ["mesh", "node", "both"])
def test_default_weights_of_morph_targets(where, saved):
    """Those of the node override those of the mesh."""
    made = Gltf()
    up, right = np.float32([[0, 0, 1]] * 4), made.sparse(4, [2], [[4, 0, 0]])
    targets = [{"POSITION": made.accessor(up)}, {"POSITION": right}]
    made.primitive({"POSITION": QUAD}, indices=made.accessor(np.uint8([0, 1, 2])), targets=targets)
    if where != "node":
        made.document["meshes"][0]["weights"] = [0.5, 0.25] if where == "mesh" else [9, 9]
    if where != "mesh":
        made.document["nodes"][0]["weights"] = [0.5, 0.25]
    expected = QUAD + [0, 0, 0.5]
    expected[2, 0] += 1
    np.testing.assert_allclose(read_gltf(saved(made))[0].vertices, expected)


@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize(
    "mode, faces",
    [(5, [[0, 1, 2], [1, 3, 2], [2, 3, 4]]), (6, [[1, 2, 0], [2, 3, 0], [3, 4, 0]])],
    ids=["strip", "fan"],
)
def test_strips_and_fans(mode, faces, indexed, saved):
    """All triangles of a strip have the same orientation."""
    made = Gltf()
    order = np.array([4, 2, 0, 1, 3]) if indexed else np.arange(5)
    indices = {"indices": made.accessor(order.astype("u4"))} if indexed else {}
    positions = np.float32(np.random.default_rng(0).random((5, 3)))
    made.primitive({"POSITION": positions}, mode=mode, **indices)
    np.testing.assert_array_equal(read_gltf(saved(made))[0].faces, order[np.array(faces)])


def test_nodes_are_placed_by_all_their_parents_and_skins_by_their_joints(saved):
    made = textured_quad(FOUR)
    turn = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # +x becomes +y
    made.document["nodes"] = [
        {"children": [1], "translation": [0, 0, 5]},
        {"mesh": 0, "rotation": turn, "scale": [2, 3, 4], "translation": [1, 0, 0]},
    ]
    (part,) = read_gltf(saved(made))
    np.testing.assert_allclose(part.vertices[2], [1 - 3, 2, 5], atol=1e-12)
    made.document["nodes"] = [{"mesh": 0, "scale": [-1, 1, 1]}]
    (part,) = read_gltf(saved(made))
    a, b, c = part.vertices[part.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0
    skinned = {"mesh": 0, "skin": 0, "translation": [9, 9, 9]}
    made = Gltf(nodes=[skinned, {}, {"translation": [3, 0, 0]}])
    made.document["scenes"][0]["nodes"] = [0, 1, 2]
    bind = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    bind[1, 3, 0] = -1.0  # column-major: it was bound one unit along x
    made.add("skins", joints=[1, 2], inverseBindMatrices=made.accessor(bind.reshape(2, 16)))
    joints, weights = np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.float32)
    joints[2:, 0], weights[:, 0] = 1, 1
    attributes = {"POSITION": QUAD, "JOINTS_0": joints, "WEIGHTS_0": weights}
    made.primitive(attributes, indices=made.accessor(np.uint8([0, 1, 2])))
    expected = QUAD + np.array([[0, 0, 0], [0, 0, 0], [2, 0, 0], [2, 0, 0]])
    np.testing.assert_allclose(read_gltf(saved(made))[0].vertices, expected)


def test_points_are_for_point_clouds_which_take_the_colours_of_a_meshs_texture_too(saved):
    """Coordinates outside [0, 1] repeat, as for a mesh prior."""
    made = Gltf()
    colors = made.accessor(np.uint8([[255, 0, 0, 255]] * 4), normalized=True)
    made.primitive({"POSITION": QUAD, "COLOR_0": colors}, mode=0)
    path = saved(made)
    cloud = PointCloudPrior({"path": str(path), "up": "+z", "front": "+x"})("a fox")
    np.testing.assert_array_equal(cloud.points, QUAD)
    np.testing.assert_array_equal(cloud.colors, [[1, 0, 0]] * 4)
    refused("no faces", load_mesh, path)
    uv = np.float32([[1.25, 0.25], [-0.25, 0.25], [3.25, 1.75], [0.75, -0.25]])
    path = saved(textured_quad(FOUR, uv=uv, sampler=NEAREST))
    cloud = PointCloudPrior({"path": str(path)})("a fox")
    np.testing.assert_array_equal(cloud.colors, np.array([RED, GREEN, BLUE, WHITE]) / 255)


def test_extensions_that_are_required_and_not_read_are_named(saved):
    for name in "KHR_draco_mesh_compression EXT_meshopt_compression KHR_texture_basisu A".split():
        with pytest.raises(UserError, match=f"requires the glTF extension '{name}'"):
            read_gltf(saved(textured_quad(FOUR, extensionsRequired=[name])))
    names = ["KHR_materials_unlit", "KHR_texture_transform", "KHR_materials_clearcoat"]
    assert read_gltf(saved(textured_quad(FOUR, extensionsRequired=names)))


def changed(made, path, value):
    functools.reduce(operator.getitem, path[:-1], made.document)[path[-1]] = value
    return made


@pytest.mark.parametrize(
    "path, value, message",
    [
        (("asset",), {"version": "1.0"}, "glTF of version 1.0"),
        (("nodes", 0, "extensions"), {"EXT_mesh_gpu_instancing": {}}, "EXT_mesh_gpu_instancing"),
        (("nodes", 0, "children"), [0], "node 0 has two parents"),
        (("nodes", 0, "rotation"), [1, 2], "4 numbers were expected"),
        (("nodes", 0, "mesh"), 7, "names number 7 of 1 meshes"),
        (("nodes", 0, "mesh"), -1, "names number -1 of 1 meshes"),
        (("meshes", 0, "primitives", 0, "mode"), 9, "mode 9 is unknown"),
        (("meshes", 0, "primitives", 0, "indices"), 1, "SCALAR was expected"),
        (("accessors", 1, "count"), 10**6, "damaged"),
        (("accessors", 1, "count"), 3, "vertex beyond the last of 3"),
        (("accessors", 1, "componentType"), 1, "component type 1"),
        (("accessors", 1), {"count": 4, "type": "VEC3", "componentType": 5126}, "aren't in the fi"),
        (("bufferViews", 0, "byteLength"), 10**12, "ends after its buffer"),
        (("bufferViews", 2), {"buffer": 0, "byteLength": 0}, "ends after its buffer view"),
        (("samplers", 0, "wrapS"), 5, "damaged"),
        (("textures", 0), {"extensions": {"KHR_texture_basisu": {}}}, "KHR_texture_basisu"),
        (("images", 0), {"uri": "https://example.org/a.png"}, "only files beside the mesh"),
        (("images", 0, "bufferView"), 1, "texture 0 .* in none of the formats"),
        (("scenes",), 5, "damaged"),
    ],
)
def test_damage_is_one_message(path, value, message, saved):
    refused(message, read_gltf, saved(changed(textured_quad(FOUR, sampler=NEAREST), path, value)))


@pytest.mark.parametrize("many", [False, True])
def test_textures_and_instances_count_together(many, saved, monkeypatch):
    """Two images, or 2,000 nodes of one mesh, are refused before they are made."""
    monkeypatch.setattr(budget, "FIXED_BYTES", 1 << 20 if many else 1_200_000)
    monkeypatch.setattr(budget, "BYTES_PER_FILE_BYTE", 0)
    flat = np.zeros((64, 64, 3) if many else (256, 256, 3), np.uint8)
    made = textured_quad(flat)
    if many:
        made.document["nodes"] = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(500)]
        made.document["scenes"][0]["nodes"] = list(range(500))
    assert load_mesh(saved(made)).texture.size == flat.size
    if many:
        made.document["nodes"] *= 4
        made.document["scenes"][0]["nodes"] = list(range(2000))
    else:
        (first,) = made.document["meshes"][0]["primitives"]
        second = first | {"material": made.material(made.texture(flat))}
        made.document["meshes"][0]["primitives"].append(second)
    said = "too large" if many else "the texture 1 of 256 x 256 texels is too large"
    path = saved(made)
    with memory_below(64 << 20 if many else 1 << 20), pytest.raises(UserError, match=said):
        load_mesh(path)


def test_a_large_header_and_an_accessor_whose_end_overflows_are_refused(saved):
    """A PNG that announces 12,000 x 12,000 pixels in its header."""
    data = bytearray(png(FOUR))
    data[16:24] = (12000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    path, said = saved(textured_quad(bytes(data))), "12000 x 12000 texels is too large"
    with memory_below(4 << 20), pytest.raises(UserError, match=said):
        load_mesh(path)
    made = changed(textured_quad(FOUR), ("bufferViews", 3, "byteStride"), 16)
    made.document["accessors"][2] |= {"count": 2**60, "byteOffset": 16}
    refused("ends after its buffer view", read_gltf, saved(made))
