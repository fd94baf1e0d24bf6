"""USD files as OpenUSD's own parser reads them (``pip install usd-core``), and as we do."""

import struct
import sys
import zipfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.object_clouds import assert_close, ball
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.usda import (
    HARMONICS,
    read_usd,
    read_usda,
    write_usda,
    write_usdz,
)
from threestudio_gaussiandreamer.gaussians.axes import rotate
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0, sh0_colors
from threestudio_gaussiandreamer.meshes.mesh import srgb_to_linear


def read_with_pxr(path):
    """The stage and the Gaussians that OpenUSD finds in a file."""
    pytest.importorskip("pxr", reason="usd-core isn't installed")
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    quats = field.GetOrientationsAttr().Get()
    count = field.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(), np.float32)
    opacities = np.array(field.GetOpacitiesAttr().Get(), np.float64)
    gaussians = Gaussians(
        means=np.array(field.GetPositionsAttr().Get(), np.float32),
        quats=np.array([[q.GetReal(), *q.GetImaginary()] for q in quats], np.float32),
        log_scales=np.log(np.array(field.GetScalesAttr().Get(), np.float32)),
        logit_opacities=np.log(opacities / (1 - opacities)).astype(np.float32),
        sh=sh.reshape(-1, (count + 1) ** 2, 3),
    )
    return stage, field, gaussians


@pytest.mark.parametrize("degree", [0, 3])
def test_openusd_reads_what_was_written(tmp_path, degree):
    cloud = ball(50, degree)
    write_usda(tmp_path / "a.usda", cloud, ["SplatRenderMode: mip", "another"])
    stage, field, read = read_with_pxr(tmp_path / "a.usda")
    assert_close(cloud, read, means=0, sh=0, log_scales=1e-6, opacities=1e-6)
    from pxr import UsdGeom

    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    said = stage.GetRootLayer().customLayerData["notes"]
    assert list(said) == ["SplatRenderMode: mip", "another"]
    primvar = UsdGeom.Primvar(field.GetRadianceSphericalHarmonicsCoefficientsAttr())
    assert primvar.GetElementSize() == (degree + 1) ** 2 and primvar.GetInterpolation() == "vertex"
    assert stage.GetDefaultPrim().IsValid()
    low, high = np.array(field.GetExtentAttr().Get())
    assert (low < cloud.means.min(axis=0)).all() and (high > cloud.means.max(axis=0)).all()
    write_usdz(tmp_path / "a.usdz", cloud)
    assert_close(cloud, read_with_pxr(tmp_path / "a.usdz")[2], opacities=1e-6)
    write_usda(tmp_path / "b.usda", ball(0))
    stage, field, _ = read_with_pxr(tmp_path / "b.usda")
    assert stage.GetDefaultPrim().IsValid() and len(field.GetPositionsAttr().Get()) == 0


def test_texts_of_several_lines_z_up_and_what_openusd_writes_are_read(tmp_path):
    """NVIDIA's converter writes such a comment, and OpenUSD other texts."""
    cloud = ball(9, 1)
    write_usda(tmp_path / "a.usda", cloud, ["a note"])
    text = (tmp_path / "a.usda").read_text()
    text = text.replace("#usda 1.0\n(", '#usda 1.0\n(\n    """Source file:\nupAxis = "X" a.ply"""')
    text = text.replace("elementSize", "doc = '''one\n) two'''\n        elementSize")
    (tmp_path / "b.usda").write_text(text)
    read, notes = read_usda(tmp_path / "b.usda")
    assert_close(cloud, read, means=0, sh=0, log_scales=1e-6, opacities=1e-6)
    assert notes == ["a note"]
    (tmp_path / "b.usda").write_text(text.replace('upAxis = "Y"', 'upAxis = "Z"'))
    in_z = StoredCloud(read_usda(tmp_path / "b.usda")[0], "y").in_axes("z").gaussians
    assert_close(cloud, in_z, opacities=1e-6)
    one = ball(1)
    one.means[:] = [[4.0, 1.0, 2.0]]  # front, left, up in our world
    write_cloud(str(tmp_path / "one.usda"), StoredCloud(one))
    assert "positions = [(1, 2, 4)]" in (tmp_path / "one.usda").read_text()
    Sdf = pytest.importorskip("pxr.Sdf", reason="usd-core isn't installed")
    cloud = ball(20, 1)
    write_usda(tmp_path / "a.usda", cloud, ["a note"])
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "a.usda"))
    prim = layer.GetPrimAtPath("/Gaussians")
    prim.documentation = "a ball"
    prim.SetInfo("kind", "component")
    Sdf.AttributeSpec(prim, "purpose", Sdf.ValueTypeNames.Token).default = "render"
    Sdf.AttributeSpec(prim, "empty", Sdf.ValueTypeNames.FloatArray)
    layer.Export(str(tmp_path / "b.usda"), "a comment")
    assert "token purpose" in (tmp_path / "b.usda").read_text()
    read, notes = read_usda(tmp_path / "b.usda")
    assert_close(cloud, read, means=0, sh=0, log_scales=1e-6, opacities=1e-6)
    assert notes == ["a note"]


MINIMAL = """def ParticleField3DGaussianSplat "G"
{
    point3f[] positions = [(0, 0, 0), (1, 0, 0)]
    float3[] scales = [(1, 1, 1), (1, 1, 1)]
    color3f[] primvars:displayColor = [(1, 0, 0), (0, 0.5, 0)]
}
"""


@pytest.mark.parametrize("layer", ["%s", 'def Xform "X" {\n%s}\n'], ids=["text", "OpenUSD"])
def test_attributes_that_are_left_out_have_defaults(tmp_path, layer):
    """As Houdini's Karma Bake GSplat leaves out the harmonics."""
    (tmp_path / "a.usda").write_text("#usda 1.0\n" + layer % MINIMAL)
    read, _ = read_usd(tmp_path / "a.usda")
    np.testing.assert_array_equal(read.quats, [[1, 0, 0, 0]] * 2)
    assert (read.logit_opacities > 10).all()
    np.testing.assert_allclose(sh0_colors(read.sh[:, 0]), [[1, 0, 0], [0, 0.7354, 0]], atol=1e-4)
    other = MINIMAL.replace("displayColor", "others")
    (tmp_path / "b.usda").write_text("#usda 1.0\n" + layer % other)
    np.testing.assert_allclose(sh0_colors(read_usd(tmp_path / "b.usda")[0].sh[:, 0]), 0.5)


@pytest.mark.parametrize("place", ["prim", "array"])
def test_linear_colours_become_display_values(tmp_path, place, caplog):
    cloud = ball(9)
    cloud.sh[:, 0] = rgb_to_sh0(srgb_to_linear(sh0_colors(ball(9).sh[:, 0])))
    write_usda(tmp_path / "a.usda", cloud)
    text = (tmp_path / "a.usda").read_text()
    space = {
        "prim": ("    float3[] scales", '    uniform token colorSpace:name = "lin_rec709_scene"\n'),
        "array": ("        elementSize", '        colorSpace = "lin_rec709_scene"\n'),
    }
    before, added = space[place]
    (tmp_path / "a.usda").write_text(text.replace(before, added + before, 1))
    for read in (read_usda(tmp_path / "a.usda")[0], by_openusd(tmp_path / "a.usda")):
        colors = sh0_colors(read.sh[:, 0])
        np.testing.assert_allclose(colors, sh0_colors(ball(9).sh[:, 0]), atol=2e-3)
    assert "linear colours become sRGB" in caplog.text


def test_a_usdz_is_as_phones_want_it_and_read_without_openusd(tmp_path, monkeypatch):
    """One layer, not compressed, at a multiple of 64 bytes; files are the same each time."""
    cloud = ball(300, 1)
    for name in ("a.usdz", "b.usdz"):
        write_usdz(tmp_path / name, cloud, ["a note"])
    data = (tmp_path / "a.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        (layer,) = archive.infolist()
        assert layer.filename.endswith(".usda") and layer.compress_type == zipfile.ZIP_STORED
    name, extra = struct.unpack_from("<HH", data, layer.header_offset + 26)
    start = layer.header_offset + 30 + name + extra
    assert start % 64 == 0 and data[start : start + 9] == b"#usda 1.0"
    assert data == (tmp_path / "b.usdz").read_bytes()
    read, notes = read_usda(tmp_path / "a.usdz")
    assert_close(cloud, read, means=0, sh=0, log_scales=1e-6, opacities=1e-6)
    assert notes == ["a note"]
    (tmp_path / "0.usdz").write_bytes(data[:40])
    (tmp_path / "1.usdz").write_bytes(data[:200])
    with zipfile.ZipFile(tmp_path / "2.usdz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.usda", data[start:])
    for number, said in enumerate(["damaged", "damaged", "it is a compressed zip archive"]):
        for read in (read_usda, read_usd):
            refused(f"{number}.usdz': .*{said}", read, tmp_path / f"{number}.usdz")
    monkeypatch.setitem(sys.modules, "pxr", None)
    (tmp_path / "a.usdc").write_bytes(b"PXR-USDC" + bytes(100))
    refused("pip install usd-core", read_usd, tmp_path / "a.usdc")
    write_usdz(tmp_path / "a.usdz", ball(20))
    assert len(read_usd(tmp_path / "a.usdz")[0].means) == 20


def by_openusd(path):
    """What the reader makes of the same layer in binary, which only OpenUSD reads."""
    Sdf = pytest.importorskip("pxr.Sdf", reason="usd-core isn't installed")
    Sdf.Layer.FindOrOpen(str(path)).Export(str(path.with_suffix(".usdc")))
    return read_usd(path.with_suffix(".usdc"))[0]


def test_binary_files_are_read_and_what_openusd_cant_read_is_said(tmp_path):
    cloud = ball(20, 3)
    stored = StoredCloud(cloud, "y", pruned_to=40.0, antialiased=True)
    write_cloud(str(tmp_path / "a.usda"), stored)
    assert_close(cloud, by_openusd(tmp_path / "a.usda"), means=0, sh=0, opacities=1e-6)
    read = read_cloud(str(tmp_path / "a.usdc"))
    assert (read.up, read.pruned_to, read.antialiased) == ("y", 40, True)
    write_usda(tmp_path / "b.usda", ball(0))
    assert by_openusd(tmp_path / "b.usda").means.shape == (0, 3)
    pytest.importorskip("pxr", reason="usd-core isn't installed")
    write_usda(tmp_path / "a.usda", ball(20))
    by_openusd(tmp_path / "a.usda")
    cut = (tmp_path / "a.usdc").read_bytes()[:900]
    (tmp_path / "b.usdc").write_bytes(cut)
    refused("b.usdc.*OpenUSD: .*corrupt", read_usd, tmp_path / "b.usdc")
    (tmp_path / "c.usda").write_text('#usda 1.0\ndef Sphere "a"\n{\n}\n')
    refused("c.usda'.*none of its prims is a ParticleField3DGauss", read_usd, tmp_path / "c.usda")
    text = (tmp_path / "a.usda").read_text().replace("Degree = 0", "Degree = 1")
    (tmp_path / "d.usda").write_text(text)
    refused("has 20 values, expected 80", read_usd, tmp_path / "d.usda")


def test_scenes_with_transforms_and_half_precision_are_read(tmp_path):
    """Two references to one prim under moved nodes, in a layer with z up."""
    pytest.importorskip("pxr", reason="usd-core isn't installed")
    from pxr import Gf, Usd, UsdGeom

    cloud = ball(20, 1)
    write_usda(tmp_path / "a.usda", cloud)
    text = (tmp_path / "a.usda").read_text()
    text = text.replace("point3f[] positions", "point3h[] positionsh")
    text = text.replace("quatf[] orientations", "quath[] orientationsh")
    (tmp_path / "a.usda").write_text(text)
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    turn, shift = Rotation.from_euler("xyz", [10, 20, 30], degrees=True), np.array([1.0, 2, 3])
    for name in ("one", "two"):
        node = UsdGeom.Xform.Define(stage, f"/World/{name}")
        node.GetPrim().GetReferences().AddReference("./a.usda")
        if name == "two":
            node.AddTranslateOp().Set(Gf.Vec3d(*shift))
            node.AddRotateXYZOp().Set(Gf.Vec3f(10, 20, 30))
            node.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
        node.GetPrim().SetTypeName("ParticleField3DGaussianSplat")
    stage.Save()
    read = read_cloud(str(tmp_path / "scene.usda")).in_axes("z").gaussians
    assert len(read.means) == 40
    rough = {"means": 2e-3, "quats": 2e-3, "opacities": 1e-6, "sh": 1e-5}
    assert_close(cloud, read.rows(slice(20)), **rough)
    moved = rotate(cloud, turn.as_matrix())
    means = (2 * moved.means + shift).astype(np.float32)
    moved = moved._replace(means=means, log_scales=moved.log_scales + np.log(2))
    assert_close(moved, read.rows(slice(20, 40)), **rough | {"means": 4e-3})


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("#usda 1.0", "#usda 2.0", "this is not a USDA file"),
        ("point3f[] positions", "point3f[] places", "no positions"),
        ("point3f[] positions", "point3h[] positions", "should be point3f[], not point3h[]"),
        ("positions = [(", "positions = [(nan_, ", "positions should consist of tuples of 3"),
        ("positions = [(", "positions = [(1 ", "could not convert"),
        ("opacities = [", "opacities = [1, ", "opacities has 3 values, expected 2"),
        ("opacities = [", "opacities = [, ", "could not convert"),
        ("Degree = 0", "Degree = 4", "should be 0 to 3, not '4'"),
        ("Degree = 0", "Degree = 1", f"{HARMONICS} has 2 values, expected 8"),
        ('upAxis = "Y"', 'upAxis = "X"', "its upAxis is [b'X']"),
        ("    float3[] scales", "    token[] xformOpOrder = [1]\n    float3[] scales", "transform"),
        ("def Particle", "over Particle", "expected one prim"),
        ("    float3[] scales", "    def Xform {", "expected one prim"),
        ("    float3[] scales", "float[] a.connect = </X.o>\n    float3[] scales", "of others"),
        ("    float3[] scales", "float[] a.timeSamples = {\n    float3[] scales", "change with"),
        ("\n}\n", "\n", "and its '}'"),
        ("\n}\n", "\n}\ndef Xform {\n}\n", "expected one prim"),
        ("(\n    default", '(\n    doc = """a\n    default', "truncated"),
    ],
)
def test_other_files_are_refused(tmp_path, before, after, said):
    write_usda(tmp_path / "a.usda", ball(2))
    text = (tmp_path / "a.usda").read_text()
    assert before in text
    (tmp_path / "b.usda").write_text(text.replace(before, after, 1))
    with pytest.raises(UserError) as error:
        read_usda(tmp_path / "b.usda")
    assert said in str(error.value) and "b.usda': " in str(error.value)
