"""Files that a mesh references, and the materials of OBJ files."""

import base64
import json
import os
import threading

import numpy as np
import pytest

from tests.helpers.gltf_builder import FOUR, NEAREST, RED, color_at, png, textured_quad
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import surface_colors
from threestudio_gaussiandreamer.priors.point_cloud import PointCloudPrior

HALF = 0.5


def gltf_beside(tmp_path, uri="picture%20one.png"):
    """Write a .gltf with its buffer as a data URI and its image in a file."""
    made = textured_quad(FOUR, sampler=NEAREST)
    made.glb()
    data = base64.b64encode(made.binary).decode()
    made.document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
    made.document["images"] = [{"uri": uri}]
    (tmp_path / "a.gltf").write_text(json.dumps(made.document))
    return tmp_path / "a.gltf"


def test_pictures_and_buffers_are_found_and_a_missing_one_is_named(tmp_path, caplog):
    (tmp_path / "picture one.png").write_bytes(png(FOUR))
    path = gltf_beside(tmp_path)
    np.testing.assert_allclose(color_at(path, 0.2, 0.8), RED / 255)
    (tmp_path / "picture one.png").unlink()
    np.testing.assert_allclose(color_at(path, 0.2, 0.8), HALF)
    assert "names the file 'picture one.png', which does not exist" in caplog.text
    np.testing.assert_allclose(PointCloudPrior({"path": str(path)})("a fox").colors, HALF)
    document = json.loads(path.read_text())
    for uri, said in (("no.bin", "is missing: a file"), ("data:,a", "is shorter .* truncated")):
        document["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(document))
        refused(f"buffer 0 {said}", load_mesh, path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="FIFOs are of Unix")
@pytest.mark.parametrize("kind", ["texture", "buffer", "mtl", "texture of an OBJ"])
def test_a_fifo_beside_a_mesh_is_refused(kind, tmp_path):
    """Opening it would wait for a writer forever."""
    os.mkfifo(tmp_path / "fifo.png")
    path = gltf_beside(tmp_path, "fifo.png")
    if kind == "buffer":
        document = json.loads(path.read_text())
        document["buffers"][0]["uri"] = "fifo.png"
        path.write_text(json.dumps(document))
    if "mtl" in kind or "OBJ" in kind:
        path = tmp_path / "a.obj"
        path.write_text(f"mtllib {'fifo.png' if kind == 'mtl' else 'a.mtl'}\n" + TRIANGLE)
        (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd fifo.png\n")
    caught = []

    def load():
        try:
            load_mesh(path)
        except UserError as error:
            caught.append(str(error))

    thread = threading.Thread(target=load, daemon=True)
    thread.start()
    thread.join(20)
    assert caught and "not a regular file" in caught[0]


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"

GREY = "map_Kd grey.png\n"


@pytest.mark.parametrize(
    ("libraries", "materials"),
    [
        (["mtllib other.mtl my a.mtl"], {"my a": f"newmtl m\n{GREY}", "other": "newmtl x\n"}),
        (['mtllib "my a.mtl" other.mtl'], {"my a": f"newmtl m\n{GREY}"}),
        (["mtllib other.mtl", "mtllib a.mtl"], {"a": f"newmtl m\n{GREY}", "other": "newmtl x\n"}),
        (["# no mtllib b.mtl", "mtllib a.mtl"], {"a": f"newmtl m\n{GREY}"}),
        (["mtllib a.mtl"], {"a": f"newmtl m\nKd 0 0 0\n{GREY}"}),  # as Poly's files
        (["mtllib a.mtl"], {"a": "newmtl m\nmap_Kd -clamp on 1 on 2.png\n"}),
        (["mtllib a.mtl"], {"a": "newmtl m\nmap_Kd -o 0 -7 0 -s 1 2 -clamp off grey.png\n"}),
        (["mtllib a.mtl"], {"a": "newmtl m\nmap_Kd -clamp on -bm 0.5 my pictures/a 1.png\n"}),
        (["mtllib a.mtl"], {"a": "newmtl m\nmap_Kd -texres 512x512 my pictures/a 1.png\n"}),
        (["mtllib a.mtl"], {"a": "newmtl m\nmap_Kd -imfchan r my pictures/a 1.png\n"}),
        (["mtllib a.mtl", "no usemtl"], {"a": f"newmtl its one\n{GREY}"}),
    ],
)
def test_the_texture_of_an_obj_is_found(libraries, materials, tmp_path):
    (tmp_path / "my pictures").mkdir()
    for name in ("grey.png", "1 on 2.png", "my pictures/a 1.png"):
        (tmp_path / name).write_bytes(png(np.uint8([[0x80]])))
    for name, text in materials.items():
        (tmp_path / f"{name}.mtl").write_text(text)
    body = TRIANGLE.replace("usemtl m\n", "") if libraries[-1] == "no usemtl" else TRIANGLE
    head = [line for line in libraries if line != "no usemtl"]
    (tmp_path / "a.obj").write_text("\n".join(head) + "\n" + body)
    mesh = load_mesh(tmp_path / "a.obj")
    color = surface_colors(mesh, np.array([0]), np.full((1, 3), 1 / 3))
    np.testing.assert_allclose(color, HALF, atol=2e-3)
    assert mesh.texture is not None


@pytest.mark.parametrize(
    ("file", "written", "encoding"),
    [
        ("my toy/grün 1.png", "my toy/grün 1.png", "utf-8"),
        ("grün.png", "grün.png", "latin-1"),
        ("木头.png", "木头.png", "gbk"),
        ("текстура.png", "текстура.png", "cp1251"),
        ("テクスチャ.png", "テクスチャ.png", "shift_jis"),
        ("gru\u0308n.png", "gr\u00fcn.png", "utf-8"),
        ("gr\u00fcn.png", "gru\u0308n.png", "utf-8"),
        ("my tex.png", '"my tex.png"', "utf-8"),
        ("my tex.png", r"my\ tex.png", "utf-8"),
        ("my tex.png", "my%20tex.png", "utf-8"),
        ("T.PNG", "t.png", "utf-8"),
    ],
)
def test_names_with_spaces_and_other_letters_are_found(file, written, encoding, tmp_path, caplog):
    """As Windows, macOS and converters write them, in the OBJ and in its MTL."""
    place = tmp_path / file
    place.parent.mkdir(exist_ok=True)
    place.write_bytes(png(np.uint8([[0x80]])))
    library = place.with_suffix(".mtl").relative_to(tmp_path)
    (tmp_path / library).write_bytes(f"newmtl m\nmap_Kd {written}\n".encode(encoding))
    stem = written.replace(".PNG", ".png").replace(".png", ".mtl")
    (tmp_path / "a.obj").write_bytes(f"mtllib {stem}\n{TRIANGLE}".encode(encoding))
    assert load_mesh(tmp_path / "a.obj").texture is not None and not caplog.text


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_texts_with_a_byte_order_mark_are_read(encoding, tmp_path):
    """As editors on Windows save them."""
    (tmp_path / "a.mtl").write_text(f"newmtl m\n{GREY}", encoding)
    (tmp_path / "grey.png").write_bytes(png(np.uint8([[0x80]])))
    for head in ("mtllib a.mtl\n", "mtllib missing.mtl\n", ""):
        (tmp_path / "a.obj").write_text(head + TRIANGLE, encoding)
        mesh = load_mesh(tmp_path / "a.obj")
        assert len(mesh.vertices) == 3 and mesh.has_colors == ("a.mtl" in head)


@pytest.mark.parametrize("name", ["p.png", "p.exr", "P.PNG "])
@pytest.mark.parametrize("content", [b"", b"not a picture"])
def test_a_texture_of_an_obj_that_is_no_picture_is_refused(name, content, tmp_path):
    (tmp_path / "a.mtl").write_text(f"newmtl m\nmap_Kd {name}\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + TRIANGLE)
    (tmp_path / name.strip()).write_bytes(content)
    refused(rf"{name.strip()}.* in none of the formats PNG", load_mesh, tmp_path / "a.obj")


@pytest.mark.parametrize("picture, expected", [(None, [1, 0.5, 0]), (np.uint16([[0x8080]]), 0.5)])
def test_an_obj_s_material(picture, expected, tmp_path, caplog):
    """Without the image its colour is used; 16-bit images aren't clipped to white."""
    kd = "Kd 1 0.5 0\n" if picture is None else ""
    (tmp_path / "a.mtl").write_text(f"newmtl m\n{kd}map_Kd p.png\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + TRIANGLE)
    if picture is not None:
        (tmp_path / "p.png").write_bytes(png(picture))
    mesh = load_mesh(tmp_path / "a.obj")
    color = surface_colors(mesh, np.array([0]), np.full((1, 3), 1 / 3))[0]
    np.testing.assert_allclose(color, np.broadcast_to(expected, 3), atol=2e-3)
    assert ("p.png" in caplog.text) == (picture is None)
