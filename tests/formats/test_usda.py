"""USDA files: as OpenUSD's own parser reads them. Optional: ``pip install usd-core``."""

import numpy as np
import pytest

from tests.helpers.object_clouds import assert_close, ball
from tests.helpers.usd_reader import read_with_pxr
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.usda import write_usda


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


def test_it_is_not_read(tmp_path):
    write_usda(tmp_path / "a.usda", ball(1))
    with pytest.raises(UserError, match="IN: expected the name of a .ply"):
        read_cloud(str(tmp_path / "a.usda"))
