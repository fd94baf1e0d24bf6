"""Clouds in files of both formats: the same object either way up, and notes that survive."""

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import gaussian_files as cloud_files
from threestudio_gaussiandreamer.formats.gaussian_files import (
    AXES,
    StoredCloud,
    file_size,
    in_axes,
    read_cloud,
    turned,
    write_cloud,
)
from threestudio_gaussiandreamer.formats.ply import read_comments, write_gaussians
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors
from threestudio_gaussiandreamer.splatting import rasterize


def cloud(count=60, degree=0):
    rng = np.random.default_rng(0)
    shapes = {
        "means": (3,),
        "sh": ((degree + 1) ** 2, 3),
        "logit_opacities": (),
        "log_scales": (3,),
        "quats": (4,),
    }
    values = {
        name: rng.normal(size=(count, *shape)).astype(np.float32) * 0.5
        for name, shape in shapes.items()
    }
    values["log_scales"] -= 2
    return Gaussians(**values)


def picture(arrays, rotation=AXES["y"]):
    """What a camera sees that is turned together with the cloud."""
    means, quats, log_scales, logits, sh = arrays.tensors()
    view = torch.eye(4)
    view[:3, :3], view[2, 3] = torch.from_numpy(rotation.T).float(), 4.0
    position = torch.from_numpy(rotation).float() @ torch.tensor([0, 0, -4.0])
    Ks = torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]])
    return rasterize(
        means,
        quats,
        log_scales.exp(),
        logits.sigmoid(),
        sh_to_colors(sh, means - position),
        view[None],
        Ks[None],
        32,
        32,
    ).image


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("up", AXES)
def test_a_turned_cloud_looks_the_same_from_a_turned_camera(up, degree):
    arrays = cloud(degree=degree)
    assert np.linalg.det(AXES[up]) == pytest.approx(1)
    assert (
        picture(turned(arrays, AXES[up]), AXES[up]) - picture(arrays)
    ).abs().max() < 1e-3  # what is fainter than 1/1024 is drawn or not


def test_our_front_and_top_are_those_of_spz():
    ours = AXES["z"]  # front +x, left +y, up +z; SPZ's x is right, y up, z towards the viewer
    np.testing.assert_array_equal(ours @ [1, 0, 0], [0, 0, 1])
    np.testing.assert_array_equal(
        ours @ [0, 1, 0], [1, 0, 0]
    )  # seen from the front, +y is on the right
    np.testing.assert_array_equal(ours @ [0, 0, 1], [0, 1, 0])


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
    back = in_axes(read, up).means
    order = [np.abs(stored.gaussians.means - mean).sum(1).argmin() for mean in back]
    np.testing.assert_allclose(back, stored.gaussians.means[order], atol=0.005)
    assert (tmp_path / "a.spz").stat().st_size == file_size(stored, ".spz")


def test_what_other_programs_write_has_the_custom_of_its_format(tmp_path):
    write_gaussians(
        tmp_path / "a.ply",
        **cloud()._asdict(),
        comments=["made by Hand", "up: north", f"{cloud_files.PRUNED} 1e400"],
    )
    read = read_cloud(str(tmp_path / "a.ply"))
    assert (read.up, read.pruned_to) == ("-y", None)
    assert read_cloud(str(tmp_path / "a.ply"), up="z").up == "z"


def test_gaussians_that_cant_be_drawn_are_left_out(tmp_path):
    arrays = cloud()
    arrays.means[3, 0], arrays.quats[7, 1] = np.nan, np.inf
    write_cloud(str(tmp_path / "a.ply"), StoredCloud(arrays))
    assert len(read_cloud(str(tmp_path / "a.ply")).gaussians.means) == 58


def test_notes_are_comments_of_the_ply(tmp_path):
    write_cloud(str(tmp_path / "a.ply"), StoredCloud(cloud(), pruned_to=39.99999999))
    assert read_comments(tmp_path / "a.ply") == ["up: z", "pruned to the likeness, dB: 40"]


def test_mistakes(tmp_path):
    with pytest.raises(
        UserError, match=r"OUT: expected the name of a .ply or .spz file, got 'a.obj'"
    ):
        write_cloud("a.obj", StoredCloud(cloud()))
    write_cloud(str(tmp_path / "a.ply"), StoredCloud(cloud()))
    with pytest.raises(UserError, match="unknown axis 'w'"):
        read_cloud(str(tmp_path / "a.ply"), up="w")
    with pytest.raises(UserError, match="a.ply"):
        read_cloud(str(tmp_path / "b.ply"))


def test_harmonics_above_degree_3_are_refused_when_read(tmp_path):
    path = str(tmp_path / "a.ply")
    write_gaussians(path, **cloud(degree=4)._asdict())
    with pytest.raises(UserError, match="harmonics of degree 4; expected 0 to 3"):
        read_cloud(path)
