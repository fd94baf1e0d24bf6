"""Read USDA files of Gaussians by OpenUSD's own parser (``pip install usd-core``)."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians


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
