"""Files of Gaussians: comments are kept, axes are stated, and files of other programs have their
usual axes.
"""

import numpy as np
import pytest

from tests.helpers.ply_files import gaussians, write_raw_gaussians
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import (
    PRUNED,
    WRITTEN,
    StoredCloud,
    file_size,
    read_cloud,
    suffix_of,
    write_cloud,
)
from threestudio_gaussiandreamer.formats.glb import write_glb
from threestudio_gaussiandreamer.formats.ply import read_comments, write_gaussians
from threestudio_gaussiandreamer.formats.spz import write_spz
from threestudio_gaussiandreamer.gaussians.axes import AXES
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.host import find

register_parts()


def cloud(count=60, degree=0):
    values = Gaussians(*(0.5 * values for values in gaussians(count, degree)))
    return values._replace(log_scales=values.log_scales - 2)


@pytest.mark.parametrize("up", AXES)
def test_a_ply_keeps_all_bits_and_says_what_is_up(tmp_path, up):
    path, stored = str(tmp_path / "a.ply"), StoredCloud(cloud(degree=1), up, 40.0)
    write_cloud(path, stored)
    read = read_cloud(path)
    assert (read.up, read.pruned_to) == (up, 40.0)
    assert all(
        a.tobytes() == b.tobytes() for a, b in zip(read.gaussians, stored.gaussians, strict=True)
    )
    assert (tmp_path / "a.ply").stat().st_size == file_size(stored, ".ply")


@pytest.mark.parametrize("up", AXES)
def test_an_spz_file_is_y_up_and_turns_back(tmp_path, up):
    path, stored = str(tmp_path / "a.spz"), StoredCloud(cloud(), up, 40.5)
    write_cloud(path, stored)
    read = read_cloud(path)
    assert (read.up, read.pruned_to) == ("y", 40.5)
    back = read.in_axes(up).gaussians.means
    order = [np.abs(stored.gaussians.means - mean).sum(1).argmin() for mean in back]
    np.testing.assert_allclose(back, stored.gaussians.means[order], atol=0.005)
    assert (tmp_path / "a.spz").stat().st_size == file_size(stored, ".spz")


def test_files_of_other_programs_have_the_axes_of_their_format(tmp_path, caplog):
    write_gaussians(
        tmp_path / "a.ply",
        cloud(),
        ["made by Hand", "up: north", f"{PRUNED} 1e400"],
    )
    read = read_cloud(str(tmp_path / "a.ply"))
    assert (read.up, read.pruned_to) == ("-y", None)
    assert "'up: north' is none of y, -y, z: it is ignored" in caplog.text
    assert read_cloud(str(tmp_path / "a.ply"), up="z").up == "z"


def test_gaussians_that_cant_be_drawn_are_left_out(tmp_path):
    arrays = cloud()
    arrays.means[3, 0], arrays.quats[7, 1] = np.nan, np.inf
    write_raw_gaussians(tmp_path / "a.ply", arrays)
    assert len(read_cloud(str(tmp_path / "a.ply")).gaussians.means) == 58


def test_notes_are_comments_of_the_ply(tmp_path):
    write_cloud(str(tmp_path / "a.ply"), StoredCloud(cloud(), pruned_to=39.99999999))
    assert read_comments(tmp_path / "a.ply") == ["up: z", "pruned to the likeness, dB: 40"]


def test_mistakes(tmp_path):
    with pytest.raises(
        UserError, match=r"OUT: expected the name of a .ply, .* or .usdz file, got 'a.obj'"
    ):
        write_cloud("a.obj", StoredCloud(cloud()))
    write_cloud(str(tmp_path / "a.ply"), StoredCloud(cloud()))
    with pytest.raises(UserError, match="unknown axis 'w'"):
        read_cloud(str(tmp_path / "a.ply"), up="w")
    with pytest.raises(UserError, match="a.ply"):
        read_cloud(str(tmp_path / "b.ply"))


def test_harmonics_above_degree_3_are_refused_when_read(tmp_path):
    path = str(tmp_path / "a.ply")
    write_raw_gaussians(path, cloud(degree=4))
    with pytest.raises(UserError, match="harmonics of degree 4; expected 0 to 3"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        (["SplatRenderMode: mip"], True),
        (["splatrendermode: MIP"], True),
        (["antialiased 1"], True),
        (["SplatRenderMode: mip", "antialiased 0"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),
        (["SplatRenderMode: 2dgs"], False),
        (["not SplatRenderMode: mip"], False),
        ([], False),
    ],
)
def test_the_comments_of_brush_and_postshot_about_antialiasing_are_read(
    tmp_path, comments, antialiased
):
    write_gaussians(tmp_path / "a.ply", cloud(), comments)
    assert read_cloud(str(tmp_path / "a.ply")).antialiased is antialiased


@pytest.mark.parametrize("suffix", WRITTEN)
def test_every_format_that_is_read_starts_a_run(tmp_path, suffix):
    write_cloud(str(tmp_path / f"a{suffix}"), StoredCloud(cloud(degree=1)))
    found = find("gaussians-prior")({"path": str(tmp_path / f"a{suffix}")}).gaussians("")
    means = cloud(degree=1).means
    nearest = [np.abs(means - mean).sum(axis=1).min() for mean in found.means]
    assert len(nearest) == 60 and max(nearest) < 0.02


def test_a_note_cant_turn_a_format_with_axes_of_its_own(tmp_path):
    write_spz(tmp_path / "a.spz", cloud(), comment="up: z")
    write_glb(tmp_path / "a.glb", cloud(), ["up: z"])
    assert [read_cloud(str(tmp_path / name)).up for name in ("a.spz", "a.glb")] == ["y", "y"]


def test_extensions_are_found_whatever_their_case():
    names = ["a.ply", "a.Compressed.PLY", "a.b.SPZ", "x.compressed.spz", "none"]
    found = [suffix_of(name) for name in names]
    assert found == [".ply", ".compressed.ply", ".spz", ".spz", ""]
