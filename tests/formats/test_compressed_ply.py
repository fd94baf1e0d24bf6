"""Compressed PLYs: laid out as published, close to what was stored, and damage is refused."""

import struct

import numpy as np
import pytest

from tests.helpers.object_clouds import ball
from tests.helpers.ply_files import saved
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.compressed_ply import (
    LIMITS,
    PACKED,
    is_compressed_ply,
    read_compressed_ply,
    write_compressed_ply,
)
from threestudio_gaussiandreamer.formats.ply import write_gaussians
from threestudio_gaussiandreamer.gaussians.sh import C0


def header(chunks=1, count=1, limits=LIMITS, rest=0, encoding="binary_little_endian"):
    lines = ["ply", f"format {encoding} 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in limits]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    lines += [f"element sh {count}"] if rest else []
    lines += [f"property uchar f_rest_{index}" for index in range(rest)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


BOUNDS = struct.pack("<18f", 0, 0, 0, 2, 4, 8, -5, -6, -7, -1, -2, -3, 0, 0.2, 0.4, 1, 0.8, 0.6)
WORDS = struct.pack(
    "<4I",
    2047 << 21 | 0 << 11 | 1023,  # x at its maximum, y at its minimum, z about the middle
    3 << 30 | 512 << 20 | 1023 << 10 | 0,  # z is the largest; w about 0, x 1/sqrt2, y -1/sqrt2
    0 << 21 | 1023 << 11 | 2047,
    255 << 24 | 0 << 16 | 128 << 8 | 51,
)
BY_HAND = header() + BOUNDS + WORDS


def test_a_file_put_together_by_hand_is_read_and_harmonics_are_clipped(tmp_path):
    read = read_compressed_ply(saved(tmp_path, BY_HAND, "a.compressed.ply"))
    np.testing.assert_allclose(read.means, [[2, 0, 8 * 1023 / 2047]], rtol=1e-6)
    np.testing.assert_allclose(read.log_scales, [[-5, -2, -3]], rtol=1e-6)
    half = 2**-0.5
    np.testing.assert_allclose(read.quats, [[half / 1023, half, -half, 0]], atol=1e-3)
    colors = 0.5 + C0 * read.sh[0, 0]
    np.testing.assert_allclose(colors, [1, 0.2, 0.4 + 0.2 * 128 / 255], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-read.logit_opacities)), [0.2], atol=1e-6)
    data = header(limits=LIMITS[:12]) + BOUNDS[:48] + WORDS  # colours without limits are fractions
    colors = 0.5 + C0 * read_compressed_ply(saved(tmp_path, data, "a.compressed.ply")).sh[0, 0]
    np.testing.assert_allclose(colors, [1, 0, 128 / 255], atol=1e-6)
    cloud = ball(3, 1)
    cloud.sh[0, 1], cloud.sh[1, 1] = 9, -9
    write_compressed_ply(tmp_path / "small.ply", cloud)
    read = read_compressed_ply(tmp_path / "small.ply")
    assert read.sh[:, 1].max() == 4 and read.sh[:, 1].min() == -4
    write_gaussians(tmp_path / "plain.ply", cloud)
    (tmp_path / "text.ply").write_text("no PLY")
    found = [is_compressed_ply(tmp_path / f"{name}.ply") for name in ("plain", "small", "text")]
    assert found == [False, True, False]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (BY_HAND[:-1], "ends before the 1 rows of 'vertex'"),
        (header(count=2) + BOUNDS + WORDS, "ends before the 2 rows of 'vertex'"),
        (header(10**12, 256 * 10**12), "ends before the 1000000000000 rows of 'chunk'"),
        (header(chunks=2) + BOUNDS + WORDS, "'chunk' has other .* rows"),
        (header(rest=10) + BOUNDS + WORDS, "'sh' has other properties"),
        (header(limits=LIMITS[::-1]) + BOUNDS + WORDS, "'chunk' has other properties"),
        (header(encoding="ascii"), "isn't binary"),
        (b"ply\nformat binary_little_endian 1.0\nend_header\n", "or has other elements"),
        (BY_HAND.replace(b"uint packed_color", b"list uint uint packed_color"), "'vertex' has oth"),
    ],
    ids=range(9),
)
def test_damaged_files_are_refused(tmp_path, data, said):
    with pytest.raises(UserError, match=f"a.compressed.ply': .*{said}"):
        read_compressed_ply(saved(tmp_path, data, "a.compressed.ply"))
