"""USDA files: as OpenUSD's own parser reads them (optional: ``pip install usd-core``), and as this
package does.
"""

import numpy as np
import pytest

from tests.helpers.object_clouds import assert_close, ball
from tests.helpers.usd_reader import read_with_pxr
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.usda import HARMONICS, write_usda
from threestudio_gaussiandreamer.formats.usda_reader import read_usda


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
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


def test_the_extent_holds_the_gaussians(tmp_path):
    cloud = ball(50)
    write_usda(tmp_path / "a.usda", cloud)
    stage, field, _ = read_with_pxr(tmp_path / "a.usda")
    assert stage.GetDefaultPrim().IsValid()
    low, high = np.array(field.GetExtentAttr().Get())
    assert (low < cloud.means.min(axis=0)).all() and (high > cloud.means.max(axis=0)).all()


def test_an_empty_cloud(tmp_path):
    write_usda(tmp_path / "a.usda", ball(0))
    stage, field, _ = read_with_pxr(tmp_path / "a.usda")
    assert stage.GetDefaultPrim().IsValid() and len(field.GetPositionsAttr().Get()) == 0


def test_axes_are_y_up(tmp_path):
    cloud = ball(1)
    cloud.means[:] = [[4.0, 1.0, 2.0]]  # front, left, up in our world
    write_cloud(str(tmp_path / "a.usda"), StoredCloud(cloud))
    assert "positions = [(1, 2, 4)]" in (tmp_path / "a.usda").read_text()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_was_written_is_read(tmp_path, degree):
    cloud = ball(50, degree)
    cloud.logit_opacities[:3] = [80, -80, 0]
    write_usda(tmp_path / "a.usda", cloud, ["SplatRenderMode: mip", "another"])
    read, notes = read_usda(tmp_path / "a.usda")
    assert_close(cloud, read, means=0, sh=0, log_scales=1e-6, opacities=1e-6)
    assert notes == ["SplatRenderMode: mip", "another"]
    assert np.isfinite(read.logit_opacities).all() and read.means.dtype == np.float32


def test_an_empty_cloud_is_read(tmp_path):
    write_usda(tmp_path / "a.usda", ball(0, 1))
    read, notes = read_usda(tmp_path / "a.usda")
    assert read.sh.shape == (0, 4, 3) and notes == []


def test_notes_and_axes_are_known_after_reading(tmp_path):
    stored = StoredCloud(ball(9), "z", pruned_to=40.0, antialiased=True)
    write_cloud(str(tmp_path / "a.usda"), stored)
    read = read_cloud(str(tmp_path / "a.usda"))
    assert (read.up, read.pruned_to, read.antialiased) == ("y", 40, True)
    assert_close(stored.gaussians, read.in_axes("z").gaussians)


def test_what_openusd_writes_is_read(tmp_path):
    # its layout has documentation, other attributes, metadata and comments
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


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("#usda 1.0", "#usda 2.0", "line 1: this is not a USDA file"),
        ("point3f[] positions", "point3f[] places", "no point3f[] positions"),
        ("point3f[] positions", "point3h[] positions", "should be point3f[], not point3h[]"),
        ("positions = [(", "positions = [(nan_, ", "positions should consist of tuples of 3"),
        ("positions = [(", "positions = [(1 ", "positions: could not convert"),
        ("opacities = [", "opacities = [1, ", "opacities has 3 values, expected 2"),
        ("opacities = [", "opacities = [, ", "opacities: could not convert"),
        ("Degree = 0", "Degree = 4", "should be 0 to 3, not '4'"),
        ("Degree = 0", "Degree = 1", f"{HARMONICS} has 2 values, expected 8"),
        ('upAxis = "Y"', 'upAxis = "Z"', "its upAxis is 'Z'"),
        ("def Particle", "over Particle", "expected one prim"),
        ("    float3[] scales", "    def Xform {", "expected an attribute on one line"),
        (
            "    float3[] scales",
            "    uniform int a = 1\n    uniform int a = 1\n    x",
            "a is given",
        ),
        ("\n}\n", "\n", "expected an attribute on one line or the prim's '}', got the end"),
        ("\n}\n", "\n}\ndef Xform", "expected one prim, but after it there is 'def Xform'"),
        ('interpolation = "vertex"\n    )', 'interpolation = "vertex"', "ends before the ')'"),
        ("\n{\n", "\n", "expected the '{' of the prim"),
        ("elementSize", "point3f[] positions = [(1, 1, 1)]\n x", "an attribute of the prim"),
        ("(\n    default", '(\n    doc = """a\n    default', "texts of several lines"),
    ],
)
def test_other_files_are_refused_with_the_line(tmp_path, before, after, said):
    write_usda(tmp_path / "a.usda", ball(2))
    text = (tmp_path / "a.usda").read_text()
    assert before in text
    (tmp_path / "b.usda").write_text(text.replace(before, after, 1))
    with pytest.raises(UserError) as error:
        read_usda(tmp_path / "b.usda")
    assert said in str(error.value) and "b.usda', line " in str(error.value)
