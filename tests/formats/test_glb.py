"""GLB files with KHR_gaussian_splatting: as published, exact, placed by their nodes."""

import functools
import json
import operator
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tests.helpers.memory import memory_below
from tests.helpers.object_clouds import assert_close, ball, in_order_of
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import glb, spz
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians import axes, sh
from threestudio_gaussiandreamer.meshes.gltf import read_gltf
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import linear_to_srgb, srgb_to_linear

PRIMITIVE = ("meshes", 0, "primitives", 0)
SPLATTING = (*PRIMITIVE, "extensions", "KHR_gaussian_splatting")
SPZ = "KHR_gaussian_splatting_compression_spz_2"
SPZ_ROUNDING = {"means": 1e-3, "log_scales": 0.04, "opacities": 5e-3, "sh": 0.08}


def read_glb(path):
    return glb.read_glb(path)[0]


def parsed(path):
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def changed(path, *places):
    """The file with values of its JSON replaced: (keys, value), or dropped where it is None."""
    document, binary = parsed(path)
    for (*keys, last), value in places:
        holder = functools.reduce(operator.getitem, keys, document)
        holder[last] = value
        if value is None:
            del holder[last]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(head + chunks + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    return path


@pytest.fixture
def path(tmp_path):
    glb.write_glb(tmp_path / "a.glb", ball(50, 1), ["one"])
    return tmp_path / "a.glb"


def test_the_document_is_as_published_and_other_programs_see_coloured_points(path):
    document, binary = parsed(path)
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    names = {name.removeprefix("KHR_gaussian_splatting:") for name in primitive["attributes"]}
    harmonics = {f"SH_DEGREE_1_COEF_{n}" for n in range(3)} | {"SH_DEGREE_0_COEF_0"}
    assert names == {"POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY"} | harmonics
    assert document["buffers"][0]["byteLength"] == len(binary)
    assert path.stat().st_size == struct.unpack_from("<I", path.read_bytes(), 8)[0]
    low = document["accessors"][0]["min"]
    assert_allclose(low, ball(50, 1).means.min(axis=0), rtol=1e-6)

    def rows(name, width):
        view = document["bufferViews"][primitive["attributes"]["KHR_gaussian_splatting:" + name]]
        return np.frombuffer(binary, "<f4", 50 * width, view["byteOffset"]).reshape(50, width)

    cloud = ball(50, 1)
    assert_allclose(rows("SCALE", 3), np.exp(cloud.log_scales), rtol=1e-6)
    np.testing.assert_array_equal(rows("SH_DEGREE_1_COEF_2", 3), cloud.sh[:, 3])
    xyzw = cloud.quats[:, [1, 2, 3, 0]] / np.linalg.norm(cloud.quats, axis=1, keepdims=True)
    assert_allclose(rows("ROTATION", 4), xyzw, atol=1e-6)
    (points,) = read_gltf(path)
    assert_allclose(points.vertices, ball(50, 1).means, atol=1e-6)
    colors = srgb_to_linear(0.5 + 0.28209479 * ball(50, 1).sh[:, 0])  # glTF's are linear
    assert_allclose(points.vertex_colors[:, :3], colors, atol=0.51 / 255)
    with pytest.raises(UserError):
        load_mesh(path)  # no faces


def test_nodes_move_turn_and_scale_their_gaussians(path):
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7])
    node = {"mesh": 0, "rotation": turn.as_quat().tolist()}
    node |= {"scale": [2, 2, 2], "translation": [1, 2, 3]}
    before, after = read_glb(path), read_glb(changed(path, (("nodes", 0), node)))
    expected = axes.rotate(before, turn.as_matrix())
    expected = expected._replace(
        means=2 * expected.means + np.float32([1, 2, 3]),
        log_scales=expected.log_scales + np.float32(np.log(2)),
    )
    assert_close(expected, after)


def test_linear_colours_become_display_values_and_another_space_is_reported(tmp_path, caplog):
    cloud = ball(50, 1)
    cloud.sh[:, 0] = sh.rgb_to_sh0(srgb_to_linear(sh.sh0_colors(cloud.sh[:, 0])))
    glb.write_glb(tmp_path / "a.glb", cloud)
    linear = changed(tmp_path / "a.glb", ((*SPLATTING, "colorSpace"), "lin_rec709_display"))
    read = read_glb(linear)
    assert_allclose(sh.sh0_to_rgb(read.sh[:, 0]), sh.sh0_colors(ball(50, 1).sh[:, 0]), atol=2e-3)
    # a small harmonic moves the display value as it moves the linear one
    step = cloud._replace(sh=cloud.sh.copy())
    step.sh[:, 0] += 1e-3 * cloud.sh[:, 1]
    moved = linear_to_srgb(sh.sh0_to_rgb(step.sh[:, 0])) - sh.sh0_to_rgb(read.sh[:, 0])
    assert_allclose(moved, sh.C0 * 1e-3 * read.sh[:, 1], rtol=0.05, atol=1e-5)
    assert "linear colours become sRGB" in caplog.text
    read_glb(changed(linear, ((*SPLATTING, "colorSpace"), "srgb_p3_display")))
    assert "colours of 'srgb_p3_display' are read as sRGB" in caplog.text


def test_other_extensions_inside_do_no_harm_and_splat_transforms_files_face_the_front(path):
    """Their front is where the camera of a PLY with -y up is, -z."""
    read = read_glb(path)
    inner = {"EXT_splat_lod": {"level": 1}, "KHR_x_compression_y": {"bufferView": 0}}
    assert_close(read, read_glb(changed(path, ((*SPLATTING, "extensions"), inner))))
    turned = read_glb(changed(path, (("asset", "generator"), "splat-transform 2.7.1")))
    np.testing.assert_array_equal(turned.means, ball(50, 1).means * np.float32([-1, 1, -1]))


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_inside_is_as_cesium_reads_it(tmp_path, degree):
    """CesiumJS needs each attribute, without OPACITY, a matrix, and SPZ's axes as they are."""
    cloud = ball(100, degree)
    write_cloud(str(tmp_path / "a.spz.glb"), StoredCloud(cloud, "y", antialiased=True))
    document, binary = parsed(tmp_path / "a.spz.glb")
    (primitive,), names = document["meshes"][0]["primitives"], {"POSITION", "COLOR_0"}
    names |= {f"KHR_gaussian_splatting:{name}" for name in ("ROTATION", "SCALE")}
    orders = [(d, n) for d in range(1, degree + 1) for n in range(2 * d + 1)]
    names |= {f"KHR_gaussian_splatting:SH_DEGREE_{d}_COEF_{n}" for d, n in orders}
    assert set(primitive["attributes"]) == names and "matrix" in document["nodes"][0]
    assert not any("bufferView" in accessor for accessor in document["accessors"])
    color = document["accessors"][primitive["attributes"]["COLOR_0"]]
    assert color == {"componentType": 5121, "count": 100, "type": "VEC4", "normalized": True}
    packed = binary[: document["bufferViews"][0]["byteLength"]]
    read = read_cloud(str(tmp_path / "a.spz.glb"))
    assert_close(spz.spz_arrays(packed)[0], read.gaussians)
    assert read.antialiased and read.up == "y"
    assert_close(in_order_of(cloud, read.gaussians), read.gaussians, **SPZ_ROUNDING)
    assert (tmp_path / "a.spz.glb").stat().st_size < 40 * 100 + 8000
    # with the published metadata its axes are half a turn away
    turned = read_glb(changed(tmp_path / "a.spz.glb", ((*SPLATTING, "kernel"), "ellipse")))
    np.testing.assert_array_equal(turned.means, read.gaussians.means * np.float32([-1, 1, -1]))


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ((("accessors", 0, "count"), 7), "SPZ has 50 rows for 7 Gaussians"),
        ((("bufferViews", 0, "byteLength"), 99), "truncated"),
        (((*SPLATTING, "extensions"), {"KHR_new_compression": {}}), "compressed by .'KHR_new"),
        (((*SPLATTING, "extensions", SPZ), {}), "names number None of 1 bufferViews"),
    ],
    ids=range(4),
)
def test_damaged_spz_inside_is_refused(tmp_path, place, said):
    write_cloud(str(tmp_path / "a.spz.glb"), StoredCloud(ball(50), "y"))
    refused(said, read_glb, changed(tmp_path / "a.spz.glb", place))


@pytest.mark.parametrize(
    ("places", "said"),
    [
        ([((*SPLATTING, "kernel"), "square")], "kernel 'square'; 'ellipse' was expected"),
        ([((*PRIMITIVE, "extensions"), None), (("extensionsUsed",), None)], "holds no Gaussians"),
        ([((*PRIMITIVE, "attributes", "KHR_gaussian_splatting:SCALE"), None)], "lack the .*SCALE"),
        ([((*PRIMITIVE, "attributes", "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"), None)], "lack"),
        ([(("accessors", 3, "count"), 40)], "SCALE has 40 rows for 50 Gaussians"),
        ([(("accessors", 0, "count"), 10**9)], "1000000000 Gaussians would take .* of memory"),
        ([(("nodes", 0), {"mesh": 0, "scale": [1, 2, 1]})], "scales them by different factors"),
        ([(("nodes", 0), {"mesh": 0, "scale": [-1, 1, 1]})], "mirrors its Gaussians"),
        ([(("nodes", 0), {"mesh": 0, "scale": [0, 0, 0]})], "mirrors its Gaussians"),
        ([(("bufferViews", 2, "byteLength"), 10**9)], "ends after its buffer"),
        ([(("meshes", 0, "primitives"), [7])], "damaged or of another format"),
    ],
    ids=range(11),
)
def test_damaged_and_foreign_files_are_refused(path, places, said):
    refused(said, read_glb, changed(path, *places))


def test_logarithms_of_drafts_are_read_and_many_nodes_cost_no_memory(tmp_path, caplog):
    cloud = ball(5)
    glb.write_glb(tmp_path / "a.glb", cloud)
    data = (tmp_path / "a.glb").read_bytes()
    scales = np.exp(cloud.log_scales).tobytes()
    assert scales in data
    (tmp_path / "a.glb").write_bytes(data.replace(scales, cloud.log_scales.tobytes()))
    assert_close(cloud, read_glb(tmp_path / "a.glb"), opacities=1e-6)
    assert "scales are read as logarithms" in caplog.text
    one = np.exp(cloud.log_scales)
    one[0, 0] = -1
    (tmp_path / "a.glb").write_bytes(data.replace(scales, one.tobytes()))
    refused("some of its scales are below 0", read_glb, tmp_path / "a.glb")
    glb.write_glb(tmp_path / "a.glb", ball(2000))
    nodes, all_nodes = [{"mesh": 0}] * 1000, list(range(1000))
    bomb = changed(tmp_path / "a.glb", (("nodes",), nodes), (("scenes", 0, "nodes"), all_nodes))
    said = "2000000 Gaussians would take .* of memory"
    with memory_below(8 << 20), pytest.raises(UserError, match=said):
        read_glb(bomb)
