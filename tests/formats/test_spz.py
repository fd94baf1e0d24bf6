"""SPZ files: laid out as published, close to what was stored, and safe to read when damaged."""

import functools
import gzip
import struct
import sys

import numpy as np
import pytest
import torch
import zstandard

from tests.helpers.memory import memory_below
from tests.helpers.object_clouds import in_order_of
from tests.helpers.ply_files import gaussians
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import packing, spz
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors

packed = functools.partial(gzip.compress, mtime=0)
"""Without the time, which would end up in the names of tests."""


def read_spz(path):
    return spz.read_spz(path)[0]


def cloud(count=300, degree=0, seed=0):
    values = gaussians(count, degree, seed)
    values.sh[:, 1:] *= 0.2
    return values._replace(log_scales=values.log_scales - 4)


def stored(tmp_path, data, name="a.spz"):
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


# Two Gaussians put together by hand from the published description, every number worked out on
# paper: version 3, degree 1, 8 fractional bits; positions 256, -128, 513 in 1/256.
HEADER = b"NGSP" + bytes([3, 0, 0, 0]) + bytes([2, 0, 0, 0]) + bytes([1, 8, 0, 0])
POSITIONS = bytes([0x00, 0x01, 0x00, 0x80, 0xFF, 0xFF, 0x01, 0x02, 0x00]) + bytes(9)
ALPHAS, COLORS = bytes([51, 204]), bytes([255, 0, 51]) + bytes([204, 102, 153])
SCALES = bytes([96, 160, 0]) + bytes([128, 112, 255])
# the first: w largest (3), x and z of magnitude 511/511/sqrt2 and 0, y = -256/511/sqrt2; the
# second: x largest (0), all others 0
ROTATIONS = struct.pack("<II", 3 << 30 | 511 << 20 | (512 | 256) << 10, 0)
HARMONICS = bytes([128, 136, 64]) + bytes([128] * 3) + bytes([192] * 3) + bytes([128] * 9)
BLOCKS = [POSITIONS, ALPHAS, COLORS, SCALES, ROTATIONS, HARMONICS]
BY_HAND = HEADER + b"".join(BLOCKS)


def version_4(blocks=BLOCKS, *, count=2, flags=0, degree=1, extension=b"", streams=6, sizes=None):
    """The same as version 4, put together from the published description."""
    frames = [zstandard.compress(block) for block in blocks]
    sizes = sizes or [len(block) for block in blocks]
    table = b"".join(struct.pack("<QQ", len(a), b) for a, b in zip(frames, sizes, strict=True))
    head = b"NGSP" + struct.pack("<IIBBBB", 4, count, degree, 8, flags, streams)
    return b"".join([head, struct.pack("<I12x", 32 + len(extension)), extension, table, *frames])


@pytest.mark.parametrize("version", [3, 4])
def test_a_file_put_together_by_hand_is_read(tmp_path, version):
    read = read_spz(stored(tmp_path, packed(BY_HAND) if version == 3 else version_4()))
    np.testing.assert_array_equal(read.means, [[1.0, -0.5, 513 / 256], [0, 0, 0]])
    np.testing.assert_allclose(1 / (1 + np.exp(-read.logit_opacities)), [0.2, 0.8], atol=1e-6)
    colors = np.array([[0.5, -0.5, -0.3], [0.3, -0.1, 0.1]])
    np.testing.assert_allclose(read.sh[:, 0], colors / 0.15, atol=1e-5)
    np.testing.assert_array_equal(read.log_scales, [[-4, 0, -10], [-2, -3, 255 / 16 - 10]])
    y = -256 / 511 / np.sqrt(2)
    first = [np.sqrt(1 - 0.5 - y * y), np.sqrt(0.5), y, 0]  # wxyz
    np.testing.assert_allclose(read.quats, [first, [0, 1, 0, 0]], atol=1e-6)
    np.testing.assert_array_equal(read.sh[0, 1:], [[0, 0.0625, -0.5], [0, 0, 0], [0.5, 0.5, 0.5]])


@pytest.mark.parametrize("version", [1, 2])
def test_versions_1_and_2_are_read(tmp_path, version):
    """Three components of the quaternion as bytes; version 1 has positions of float16."""
    header = BY_HAND[:4] + bytes([version]) + BY_HAND[5:16]
    halves = np.float16([[1, -0.5, 513 / 256], [0, 0.25, 65504]])
    positions = halves.tobytes() if version == 1 else POSITIONS
    rotations = bytes([255, 128, 128, 128, 0, 128])  # x = 1 and y = -1, as (byte / 127.5) - 1
    data = header + positions + ALPHAS + COLORS + SCALES + rotations + HARMONICS
    read = read_spz(stored(tmp_path, packed(data)))
    np.testing.assert_array_equal(read.means[0], [1, -0.5, 513 / 256])
    np.testing.assert_array_equal(read.means[1], halves[1] if version == 1 else 0)
    np.testing.assert_allclose(read.quats, [[0, 1, 0, 0], [0, 0, -1, 0]], atol=0.005)
    np.testing.assert_array_equal(read.sh[0, 3], [0.5, 0.5, 0.5])


def test_harmonics_of_degree_4_are_read(tmp_path):
    rest = np.arange(144, dtype=np.uint8)
    body = gzip.decompress(with_header(degree=4))[: -len(HARMONICS)] + rest.tobytes()
    read = read_spz(stored(tmp_path, packed(body)))
    np.testing.assert_array_equal(128 * read.sh[:, 1:].ravel() + 128, rest)


@pytest.mark.parametrize("degree", [0, 3])
def test_values_are_rounded_to_half_a_step(tmp_path, degree):
    arrays = cloud(degree=degree)
    spz.write_spz(tmp_path / "a.spz", arrays, ["kept", "up: y", packing.ANTIALIASED])
    read, notes = spz.read_spz(tmp_path / "a.spz")
    assert notes == ["kept", "up: y", packing.ANTIALIASED]
    arrays = in_order_of(arrays, read)
    size = np.exp(np.median(arrays.log_scales.mean(1)))
    assert np.abs(read.means - arrays.means).max() <= size / 64 * 1.001
    assert np.abs(read.log_scales - arrays.log_scales).max() <= 1 / 32 + 1e-5
    constant = arrays.sh[:, :1].clip(-0.5 / 0.15, 0.5 / 0.15)
    assert np.abs(read.sh[:, :1] - constant).max() <= 0.5 / 255 / 0.15 + 1e-5
    if degree:  # of 4 bits; the last step is short
        clipped = arrays.sh[:, 1:].clip(-1, 0.93)
        assert np.abs(read.sh[:, 1:] - clipped).max() <= 1.01 / 16 + 0.5 / 128


def test_both_versions_hold_the_same_and_files_are_small_and_reproducible():
    arrays, found = cloud(2000, 3), []
    for version in (3, 4):
        data = spz.spz_bytes(arrays, version=version)
        assert data == spz.spz_bytes(arrays.rows(slice(None, None, -1)), version=version)
        assert len(data) < 51 * 2000  # random values pack worse than trained ones
        found.append(spz.spz_arrays(data)[0])
        assert spz.spz_arrays(spz.spz_bytes(cloud(0), version=version))[0].sh.shape == (0, 1, 3)
        assert spz.spz_arrays(spz.spz_bytes(cloud(5), [packing.ANTIALIASED], version=version))[1]
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))


def test_extremes_are_stored_within_the_formats_reach_and_nan_is_refused():
    arrays = cloud(4)
    arrays.log_scales[:] = [[-np.inf] * 3, [-50] * 3, [50] * 3, [0] * 3]
    arrays.logit_opacities[:] = [np.inf, -np.inf, 50, -50]
    arrays.quats[0], arrays.sh[:] = 0, 100
    arrays.means[:] = np.arange(12).reshape(4, 3) * 1000.0
    read = spz.spz_arrays(spz.spz_bytes(arrays))[0]
    read = read.rows(read.means[:, 0].argsort())
    np.testing.assert_array_equal(read.log_scales[:, 0], [-10, -10, 255 / 16 - 10, 0])
    assert np.isfinite(read.logit_opacities).all()
    assert (np.sign(read.logit_opacities) == [1, -1, 1, -1]).all()
    np.testing.assert_array_equal(read.quats[0], [1, 0, 0, 0])
    assert (sh_to_colors(torch.from_numpy(read.sh), torch.ones(4, 3)) > 1.4).all()
    np.testing.assert_allclose(read.means, arrays.means, atol=0.001)
    # Niantic's reader takes the logit of the byte over 255
    assert sorted(gzip.decompress(spz.spz_bytes(arrays))[16 + 4 * 9 :][:4]) == [0, 0, 254, 254]
    arrays = cloud(20)
    arrays.means[3], arrays.sh[5] = np.nan, np.inf
    high = cloud(1)._replace(sh=np.zeros((1, 25, 3), np.float32))
    for bad, match in ((arrays, "can't hold NaN or"), (high, "up to degree 3, not 4")):
        refused(match, spz.spz_bytes, bad)


def test_one_gaussian_beyond_the_range_is_clipped_and_the_rest_stays_precise(tmp_path, caplog):
    arrays, size = cloud(300), float(np.exp(-4))
    arrays.means[7], arrays.means[9, 1], arrays.log_scales[11, 0] = 1e7, -3e38, 9
    spz.write_spz(tmp_path / "a.spz", arrays)
    assert caplog.text.count("a.spz: 3 of 300 Gaussians are farther away or larger") == 1
    read = read_spz(tmp_path / "a.spz")
    assert len(read.means) == 300 and all(np.isfinite(values).all() for values in read)
    near = np.delete(arrays.means, [7, 9], axis=0)
    nearest = np.abs(near[:, None] - read.means[None]).max(axis=2).min(axis=1)
    assert nearest.max() <= size / 2
    caplog.clear()
    far = cloud(50)._replace(means=cloud(50).means + np.float32(1e6))  # as a whole
    spz.write_spz(tmp_path / "b.spz", far._replace(log_scales=far.log_scales - 20))
    read = read_spz(tmp_path / "b.spz")
    assert not caplog.text and np.abs(read.means.mean(axis=0) - 1e6).max() < 1


def axes(number):
    """SPZ_ADOBE_coordinate_system after another record."""
    return struct.pack("<IIBIII", 0xADBE0002, 1, 0, 0xADBE0003, 4, number)


def covariances(cloud):
    from scipy.spatial.transform import Rotation

    frames = Rotation.from_quat(cloud.quats[:, [1, 2, 3, 0]]).as_matrix()
    return frames * np.exp(2 * cloud.log_scales)[:, None] @ frames.transpose(0, 2, 1)


@pytest.mark.parametrize(
    ("number", "matrix"),
    [
        (4, np.eye(3)),
        (6, np.diag([1, -1, -1])),  # RDF, the axes of a PLY
        (8, np.diag([1, 1, -1])),  # RUF, Unity's, mirrored
        (12, [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),  # RFU, z up
    ],
)
def test_the_record_of_the_axes_is_honoured(tmp_path, number, matrix, caplog):
    """Positions, covariances and colours turn alike; other extensions are skipped."""
    plain = read_spz(stored(tmp_path, version_4()))
    turned = read_spz(stored(tmp_path, version_4(flags=2, extension=axes(number))))
    assert "vendor extension 0xadbe0002, which is ignored" in caplog.text
    matrix = np.array(matrix, float)
    np.testing.assert_allclose(turned.means, plain.means @ matrix.T, atol=1e-6)
    for ours, old in zip(covariances(turned), covariances(plain), strict=True):
        np.testing.assert_allclose(ours, matrix @ old @ matrix.T, atol=1e-5)
    # degree 1 is (-y, z, -x): a vector
    ours, old = (cloud.sh[:, [3, 1, 2]] * [[-1], [-1], [1]] for cloud in (turned, plain))
    np.testing.assert_allclose(ours, matrix @ old, atol=1e-5)
    by_gzip = packed(BY_HAND[:14] + b"\2" + BY_HAND[15:] + axes(number))
    np.testing.assert_array_equal(read_spz(stored(tmp_path, by_gzip)).means, turned.means)


@pytest.mark.parametrize(("up", "number"), [("y", 4), ("-y", 6)])
def test_the_record_of_the_axes_is_written(tmp_path, up, number):
    """By version 4: the same cloud is read whichever axes it is stored in."""
    write_cloud(str(tmp_path / "a.spz"), StoredCloud(cloud(), "z"), spz_version=4, spz_up=up)
    write_cloud(str(tmp_path / "b.spz"), StoredCloud(cloud(), "z"))
    data = (tmp_path / "a.spz").read_bytes()
    assert data[14] & 2 and struct.unpack_from("<I12xIII", data, 16) == (44, 0xADBE0003, 4, number)
    ours, plain = (read_spz(tmp_path / name) for name in ("a.spz", "b.spz"))
    order, other = (np.lexsort(np.rint(300 * found.means.T)) for found in (ours, plain))
    np.testing.assert_allclose(ours.means[order], plain.means[other], atol=2e-3)
    np.testing.assert_allclose(ours.sh[order], plain.sh[other], atol=0.07)


def with_header(version=3, count=2, degree=1, magic=b"NGSP"):
    return packed(struct.pack("<4sIIBBBB", magic, version, count, degree, 8, 0, 0) + BY_HAND[16:])


SIZES = [18, 2, 6, 6, 8, 18]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "damaged or of another format"),
        (packed(b"short"), "damaged or of another format"),
        (packed(BY_HAND)[:-20], "it is truncated"),
        (packed(BY_HAND)[:-8] + bytes(8), "incorrect data check"),
        (b"NGSP" + bytes(40), "isn't an SPZ file of version 1 to 4"),
        (with_header(magic=b"NGSX"), "isn't an SPZ file of version 1 to 4"),
        (with_header(version=0), "isn't an SPZ file of version 1 to 4"),
        (with_header(degree=5), "degree 5 are announced"),
        (with_header(count=3), "it is truncated"),
        (with_header(count=2**32 - 1), "of memory"),
        (version_4()[:-1], "truncated or damaged"),
        (version_4()[:20], "damaged or of another format"),
        (version_4() + b"\0", "truncated or damaged"),
        (version_4(streams=5), "its table of blocks is damaged"),
        (version_4(count=2**32 - 1), "of memory"),
        (version_4(degree=5), "degree 5 are announced"),
        (version_4(sizes=[*SIZES[:-1], 17]), "truncated or damaged"),
        (version_4([*BLOCKS[:-1], HARMONICS + b"\0"], sizes=SIZES), "of another size"),
        (version_4().replace(b"\x28\xb5\x2f\xfd", b"abcd"), "Zstd"),
        (version_4(flags=2, extension=axes(17)), "axes has the number 17: 1 to 16"),
    ],
    ids=range(20),
)
def test_damaged_and_foreign_files_are_refused(tmp_path, data, said):
    refused(f"a.spz': .*{said}", read_spz, stored(tmp_path, data))


def test_a_file_that_unpacks_to_more_than_it_announces_costs_no_memory(tmp_path):
    path = stored(tmp_path, packed(BY_HAND + bytes(80_000_000), 1))
    with memory_below(10 * path.stat().st_size):  # 360 kB packed
        assert len(read_spz(path).means) == 2
    path = stored(tmp_path, version_4([POSITIONS + bytes(80_000_000), *BLOCKS[1:]], sizes=SIZES))
    with memory_below(1 << 20), pytest.raises(UserError, match="of another size"):
        read_spz(path)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_small_file_of_many_gaussians_is_refused_before_they_are_unpacked(tmp_path, degree):
    """Deflate packs up to 1032 bytes into one: 50 kB would take 0.5 GB."""
    count = 2_000_000 // (1 + degree)
    size = 20 + 3 * ((degree + 1) ** 2 - 1)
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, count, degree, 8, 0, 0)
    path = stored(tmp_path, packed(head + bytes(count * size), 9))
    said = f"{count} Gaussians would take .* of memory"
    with memory_below(10 * path.stat().st_size), pytest.raises(UserError, match=said):
        read_spz(path)


def test_without_zstandard_version_4_is_refused_by_name(tmp_path, monkeypatch):
    path = stored(tmp_path, version_4())
    monkeypatch.setitem(sys.modules, "zstandard", None)
    refused("pip install zstandard", spz.spz_bytes, cloud(), version=4)
    refused("pip install zstandard", read_spz, path)
