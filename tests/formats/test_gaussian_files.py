"""Files of Gaussians: comments are kept, axes are stated, and files of other programs have their
usual axes.
"""

import numpy as np
import pytest

from tests.helpers.ply_files import gaussians, write_raw_gaussians
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import (
    PRUNED,
    StoredCloud,
    file_size,
    read_cloud,
    write_cloud,
)
from threestudio_gaussiandreamer.formats.ply import read_comments, write_gaussians
from threestudio_gaussiandreamer.gaussians.axes import AXES
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians


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


def test_files_of_other_programs_have_the_axes_of_their_format(tmp_path):
    write_gaussians(
        tmp_path / "a.ply",
        cloud(),
        ["made by Hand", "up: north", f"{PRUNED} 1e400"],
    )
    read = read_cloud(str(tmp_path / "a.ply"))
    assert (read.up, read.pruned_to) == ("-y", None)
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
        UserError, match=r"OUT: expected the name of a .ply, .* or .usda file, got 'a.obj'"
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
