"""``.splat`` files: 32 bytes a Gaussian, as antimatter15's viewer reads them."""

import struct

import numpy as np
import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.splat import read_splat

RECORD = struct.pack("<6f8B", 1, -2, 3, 0.5, 1, 2, 255, 0, 128, 51, 255, 128, 0, 128)


def stored(folder, data):
    (folder / "a.splat").write_bytes(data)
    return folder / "a.splat"


def test_a_record_put_together_by_hand_is_read(tmp_path):
    read = read_splat(stored(tmp_path, RECORD))
    np.testing.assert_array_equal(read.means, [[1, -2, 3]])
    np.testing.assert_allclose(read.log_scales, np.log([[0.5, 1, 2]]), rtol=1e-6)
    np.testing.assert_allclose(0.5 + 0.28209479 * read.sh[0, 0], [1, 0, 128 / 255], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-read.logit_opacities)), [0.2], atol=1e-6)
    np.testing.assert_allclose(read.quats, [[127 / 128, 0, -1, 0]])


def test_rows_that_cant_be_drawn_are_left_out(tmp_path):
    bad = [
        struct.pack("<f", np.nan) + RECORD[4:],
        RECORD[:12] + struct.pack("<f", -1) + RECORD[16:],
    ]
    read = read_cloud(str(stored(tmp_path, RECORD + b"".join(bad))))
    assert len(read.gaussians.means) == 1 and read.up == "-y"


@pytest.mark.parametrize("size", [0, 1, 33])
def test_other_sizes_are_refused(tmp_path, size):
    with pytest.raises(UserError, match=f"multiple of 32 bytes, one record a Gaussian, not {size}"):
        read_splat(stored(tmp_path, bytes(size)))


def test_it_is_not_written(tmp_path):
    stored(tmp_path, RECORD)
    cloud = read_cloud(str(tmp_path / "a.splat"))
    with pytest.raises(UserError, match="expected the name of a .ply, .* got"):
        write_cloud(str(tmp_path / "b.splat"), cloud)
