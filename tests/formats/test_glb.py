"""GLB files with KHR_gaussian_splatting: as published, exact, placed by their nodes."""

import json
import struct
import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.object_clouds import assert_close, ball
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.glb import load_glb, read_glb, write_glb
from threestudio_gaussiandreamer.gaussians.axes import rotate
from threestudio_gaussiandreamer.meshes.colors import srgb_to_linear
from threestudio_gaussiandreamer.meshes.gltf import read_gltf
from threestudio_gaussiandreamer.meshes.load import load_mesh

PRIMITIVE = ("meshes", 0, "primitives", 0)
SPLATTING = (*PRIMITIVE, "extensions", "KHR_gaussian_splatting")


def parsed(path):
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def changed(path, *places):
    """The file with values of its JSON replaced: (keys, value), or dropped where it is None."""
    document, binary = parsed(path)
    for keys, value in places:
        holder = document
        for key in keys[:-1]:
            holder = holder[key]
        if value is None:
            del holder[keys[-1]]
        else:
            holder[keys[-1]] = value
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(head + chunks + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    return path


@pytest.fixture
def path(tmp_path):
    write_glb(tmp_path / "a.glb", ball(50, 1), ["one"])
    return tmp_path / "a.glb"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_read_is_what_was_written(tmp_path, degree):
    cloud = ball(100, degree)
    write_glb(tmp_path / "a.glb", cloud, ["up there"])
    read, notes = load_glb(tmp_path / "a.glb")
    assert notes == ["up there"]
    assert_close(cloud, read, means=0, sh=0, log_scales=1e-6, opacities=1e-6)


def test_opaque_gaussians_stay_finite(tmp_path):
    cloud = ball(3)
    cloud.logit_opacities[:] = [87, -87, 20]
    write_glb(tmp_path / "a.glb", cloud)
    logits = read_glb(tmp_path / "a.glb").logit_opacities
    assert np.isfinite(logits).all() and logits[0] > 15 and logits[1] < -15


def test_the_document_is_as_published(path):
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
    np.testing.assert_allclose(low, ball(50, 1).means.min(axis=0), rtol=1e-6)


def test_programs_without_the_extension_see_coloured_points(path):
    (points,) = read_gltf(path)
    np.testing.assert_allclose(points.vertices, ball(50, 1).means, atol=1e-6)
    colors = srgb_to_linear(0.5 + 0.28209479 * ball(50, 1).sh[:, 0])  # glTF's are linear
    np.testing.assert_allclose(points.vertex_colors[:, :3], colors, atol=0.51 / 255)
    with pytest.raises(UserError):
        load_mesh(path)  # no faces


def test_nodes_move_turn_and_scale_their_gaussians(path):
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7])
    node = {
        "mesh": 0,
        "rotation": turn.as_quat().tolist(),
        "scale": [2, 2, 2],
        "translation": [1, 2, 3],
    }
    before, after = read_glb(path), read_glb(changed(path, (("nodes", 0), node)))
    expected = rotate(before, turn.as_matrix())
    expected = expected._replace(
        means=2 * expected.means + np.float32([1, 2, 3]),
        log_scales=expected.log_scales + np.float32(np.log(2)),
    )
    assert_close(expected, after)


def test_an_empty_cloud(tmp_path):
    write_glb(tmp_path / "a.glb", ball(0))
    assert read_glb(tmp_path / "a.glb").means.shape == (0, 3)


def test_another_colour_space_is_reported(path, caplog):
    read_glb(changed(path, ((*SPLATTING, "colorSpace"), "lin_rec709_display")))
    assert "colours of 'lin_rec709_display' are read as sRGB" in caplog.text


@pytest.mark.parametrize(
    ("places", "said"),
    [
        ([((*SPLATTING, "kernel"), "square")], "kernel 'square'; 'ellipse' was expected"),
        ([((*SPLATTING, "extensions"), {"KHR_spz": {}})], "compressed by KHR_spz"),
        ([((*PRIMITIVE, "extensions"), None), (("extensionsUsed",), None)], "holds no Gaussians"),
        ([((*PRIMITIVE, "attributes", "KHR_gaussian_splatting:SCALE"), None)], "lack the .*SCALE"),
        ([((*PRIMITIVE, "attributes", "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"), None)], "lack"),
        ([(("accessors", 3, "count"), 40)], "SCALE has 40 rows for 50 Gaussians"),
        ([(("accessors", 0, "count"), 10**9)], "1000000000 Gaussians would take .* of memory"),
        ([(("nodes", 0), {"mesh": 0, "scale": [1, 2, 1]})], "scales them by different factors"),
        ([(("nodes", 0), {"mesh": 0, "scale": [-1, 1, 1]})], "mirrors its Gaussians"),
        ([(("nodes", 0), {"mesh": 0, "scale": [0, 0, 0]})], "mirrors its Gaussians"),
        ([(("bufferViews", 2, "byteLength"), 10**9)], "ends after its buffer"),
        ([(("meshes", 0, "primitives"), [7])], "isn't that of a glTF file"),
    ],
    ids=range(12),
)
def test_damaged_and_foreign_files_are_refused(path, places, said):
    with pytest.raises(UserError, match=said):
        read_glb(changed(path, *places))


def test_many_nodes_of_one_mesh_cost_no_memory(tmp_path):
    """A thousand nodes would be two million Gaussians in a file of 200 kB."""
    write_glb(tmp_path / "a.glb", ball(2000))
    nodes, all_nodes = [{"mesh": 0}] * 1000, list(range(1000))
    bomb = changed(tmp_path / "a.glb", (("nodes",), nodes), (("scenes", 0, "nodes"), all_nodes))
    tracemalloc.start()
    with pytest.raises(UserError, match="2000000 Gaussians would take .* of memory"):
        read_glb(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


def test_drafts_with_logarithms_are_refused_by_name(tmp_path):
    cloud = ball(5)
    write_glb(tmp_path / "a.glb", cloud)
    data = (tmp_path / "a.glb").read_bytes()
    scales = np.exp(cloud.log_scales).tobytes()
    assert scales in data
    (tmp_path / "a.glb").write_bytes(data.replace(scales, cloud.log_scales.tobytes()))
    with pytest.raises(UserError, match="drafts of the extension before 2026 stored logarithms"):
        read_glb(tmp_path / "a.glb")
