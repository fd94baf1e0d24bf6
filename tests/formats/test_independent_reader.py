"""gsply (MIT), an independent implementation, reads the package's files. Optional: ``pip install
gsply``.
"""

import numpy as np
import pytest

from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians

gsply = pytest.importorskip("gsply", reason="gsply isn't installed")


def some(degree, count=50):
    rng = np.random.default_rng(0)
    shapes = [(3,), (4,), (3,), (), ((degree + 1) ** 2, 3)]
    gaussians = Gaussians(
        *(rng.normal(size=(count, *shape)).astype(np.float32) for shape in shapes)
    )
    gaussians.sh[:, 1:] *= 0.2
    gaussians.logit_opacities[:3] = [87, 12, -30]
    return gaussians._replace(log_scales=gaussians.log_scales - 4)


def read(path):
    data = gsply.read_spz(path) if path.suffix == ".spz" else gsply.plyread(path)
    sh = data.sh0[:, None]
    if data.shN is not None:
        sh = np.concatenate([sh, data.shN.reshape(len(sh), -1, 3)], axis=1)
    return Gaussians(data.means, data.quats, data.scales, data.opacities.reshape(-1), sh)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_holds_what_was_written(tmp_path, degree):
    stored = StoredCloud(some(degree)).in_axes("-y")
    write_cloud(str(tmp_path / "a.ply"), stored)
    for ours, theirs in zip(stored.gaussians, read(tmp_path / "a.ply"), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_an_spz_file_is_read_as_we_read_it(tmp_path, degree):
    write_cloud(str(tmp_path / "a.spz"), StoredCloud(some(degree)))
    ours, theirs = read_cloud(str(tmp_path / "a.spz")).gaussians, read(tmp_path / "a.spz")
    for name in ("means", "quats", "log_scales", "sh"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6)
    opacities = [1 / (1 + np.exp(-values.logit_opacities)) for values in (ours, theirs)]
    np.testing.assert_allclose(*opacities, atol=1 / 2000)  # the byte 0 is a logit of choice
    assert theirs.logit_opacities.max() < 6  # and 255 would be one too


def test_its_compressed_ply_is_read(tmp_path):
    means, quats, log_scales, logits, sh = some(0)
    data = gsply.GSData(means, log_scales, quats, logits, sh[:, 0], np.zeros((50, 0, 3)))
    gsply.plywrite(tmp_path / "a.compressed.ply", data, compressed=True)
    read = read_cloud(str(tmp_path / "a.compressed.ply")).gaussians
    order = [np.abs(means - mean).sum(1).argmin() for mean in read.means]
    np.testing.assert_allclose(read.means, means[order], atol=5e-3)
    np.testing.assert_allclose(read.log_scales, log_scales[order], atol=5e-3)
