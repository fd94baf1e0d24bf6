"""``.splat`` files as antimatter15's viewer reads them, ``.ksplat`` files as GaussianSplats3D's."""

import struct

import numpy as np
import pytest

from tests.helpers.object_clouds import assert_close, ball
from tests.helpers.ply_files import saved
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.splat import read_ksplat, read_splat

RECORD = struct.pack("<6f8B", 1, -2, 3, 0.5, 1, 2, 255, 0, 128, 51, 255, 128, 0, 128)


def test_a_record_put_together_by_hand_is_read(tmp_path):
    read, _ = read_splat(saved(tmp_path, RECORD, "a.splat"))
    np.testing.assert_array_equal(read.means, [[1, -2, 3]])
    np.testing.assert_allclose(read.log_scales, np.log([[0.5, 1, 2]]), rtol=1e-6)
    np.testing.assert_allclose(0.5 + 0.28209479 * read.sh[0, 0], [1, 0, 128 / 255], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-read.logit_opacities)), [0.2], atol=1e-6)
    np.testing.assert_allclose(read.quats, [[127 / 128, 0, -1, 0]])
    # rows that can't be drawn are left out
    nan, negative = struct.pack("<f", np.nan), struct.pack("<f", -1)
    bad = nan + RECORD[4:] + RECORD[:12] + negative + RECORD[16:]
    read = read_cloud(str(saved(tmp_path, RECORD + bad, "a.splat")))
    assert len(read.gaussians.means) == 1 and read.up == "-y"


def test_other_sizes_are_refused_and_it_is_not_written(tmp_path):
    for size in (0, 1, 33):
        with pytest.raises(UserError, match=f"32 bytes, one record a Gaussian, not {size}"):
            read_splat(saved(tmp_path, bytes(size), "a.splat"))
    with pytest.raises(UserError, match="expected the name of a .ply, .* got"):
        write_cloud(str(tmp_path / "b.splat"), StoredCloud(ball(1)))


COUNT, FULL, BUCKET, BLOCK = 50, 2, 16, 4.0
PARTLY = (10, 8)
STEPS = 32767


def put(header, at, kind, *values):
    data = np.array(values, kind).tobytes()
    header[at : at + len(data)] = data


def section(cloud, level):
    degree, centers = cloud.sh_degree, np.array([[0, 0, 0], [1, 0, 0], [0, 0.5, 0], [0, 0, -1]])
    lengths = [*[BUCKET] * FULL, *PARTLY]
    places = np.rint((cloud.means - np.repeat(centers, lengths, axis=0)) / (BLOCK / 2) * STEPS)
    colors = np.rint(255 * np.clip(0.5 + 0.28209479 * cloud.sh[:, 0], 0, 1)).astype("u1")
    alphas = np.rint(255 / (1 + np.exp(-cloud.logit_opacities))).astype("u1")
    bands = [cloud.sh[:, 1:4], cloud.sh[:, 4:9]][:degree]
    rest = np.concatenate([band.swapaxes(1, 2).reshape(COUNT, -1) for band in bands], 1)
    number = "<f2" if level else "<f4"
    columns = [
        (places + STEPS).astype("<u2") if level else cloud.means.astype("<f4"),
        np.exp(cloud.log_scales).astype(number),
        cloud.quats.astype(number),
        colors,
        alphas[:, None],
        np.rint((rest + 1.5) / 3 * 255).astype("u1") if level == 2 else rest.astype(number),
    ]
    records = [np.ascontiguousarray(column).view("u1").reshape(COUNT, -1) for column in columns]
    header, buckets = bytearray(1024), b""
    put(header, 0, "<u4", COUNT, COUNT)
    put(header, 40, "<u2", degree)
    if level:
        put(header, 8, "<u4", BUCKET, len(lengths))
        put(header, 16, "<f4", BLOCK)
        put(header, 20, "<u2", 12)
        put(header, 24, "<u4", STEPS)
        put(header, 32, "<u4", FULL, len(PARTLY))
        buckets = np.array(PARTLY, "<u4").tobytes() + centers.astype("<f4").tobytes()
    return bytes(header), buckets + np.concatenate(records, axis=1).tobytes()


def ksplat_file(path, level, clouds):
    header = bytearray(4096)
    put(header, 1, "u1", 1)
    put(header, 4, "<u4", len(clouds), len(clouds), COUNT * len(clouds), COUNT * len(clouds))
    put(header, 20, "<u2", level)
    sections, contents = zip(*(section(cloud, level) for cloud in clouds), strict=True)
    path.write_bytes(b"".join([bytes(header), *sections, *contents]))
    return path


@pytest.mark.parametrize("level", [0, 1, 2])
def test_all_levels_and_sections_are_read(tmp_path, level):
    clouds = [ball(COUNT, 2), ball(COUNT, 1, seed=1)]
    read = read_cloud(str(ksplat_file(tmp_path / "a.ksplat", level, clouds)))
    assert read.up == "-y" and read.gaussians.sh.shape == (2 * COUNT, 9, 3)
    steps = {"means": 1e-4, "log_scales": 1e-3, "quats": 1e-5, "opacities": 2e-3, "sh": 0.01}
    padded = np.pad(clouds[1].sh, ((0, 0), (0, 5), (0, 0)))
    for at, cloud in enumerate([clouds[0], clouds[1]._replace(sh=padded)]):
        rows = np.arange(at * COUNT, (at + 1) * COUNT)
        assert_close(cloud, read.gaussians.rows(rows), **steps)
    # a scale that float16 rounds to 0 is flat
    cloud = ball(COUNT, 1)
    cloud.log_scales[:, 2] = -30
    read = read_cloud(str(ksplat_file(tmp_path / "a.ksplat", max(level, 1), [cloud]))).gaussians
    assert len(read.means) == COUNT and (read.log_scales[:, 2] < np.log(1e-6)).all()


@pytest.mark.parametrize(
    ("at", "kind", "value", "said"),
    [
        (1, "u1", 0, "version 0.1 and level 0, 1 or 2 were expected, not version 0.0 and level 1"),
        (20, "<u2", 3, "not version 0.1 and level 3"),
        (4, "<u4", 10**9, "it ends after .* bytes instead of"),
        (4, "<u4", 0, "it has no Gaussians"),
        (4096, "<u4", 10**9, "it ends after .* bytes instead of"),
        (4096 + 32, "<u4", 10**9, "its buckets hold .* of the 50 Gaussians"),
        (4096 + 12, "<u4", 3, "its buckets hold 50 of the 50|buckets hold"),
        (4096 + 40, "<u2", 3, "harmonics of degree 3; expected 0 to 2"),
    ],
)
def test_damaged_ksplats_are_refused(tmp_path, at, kind, value, said):
    data = bytearray(ksplat_file(tmp_path / "a.ksplat", 1, [ball(COUNT, 1)]).read_bytes())
    put(data, at, kind, value)
    (tmp_path / "a.ksplat").write_bytes(data)
    with pytest.raises(UserError, match=said):
        read_ksplat(tmp_path / "a.ksplat")
