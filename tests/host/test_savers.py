"""The built-in host's savers: images, videos, arrays and meshes that can be read back."""

import json
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer import images as pictures
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host.builtin.savers import SaverMixin, write_video

TRIANGLE = SimpleNamespace(v_pos=torch.eye(3), t_pos_idx=torch.tensor([[0, 1, 2]]))


@pytest.fixture
def saver(tmp_path):
    saver = SaverMixin()
    saver.set_save_dir(str(tmp_path / "save"))
    return saver


def save_rgb(saver, name, image, **kwargs):
    return saver.save_image_grid(name, [{"type": "rgb", "img": image, "kwargs": kwargs}])


def test_colours_are_read_back_from_the_file(saver):
    image = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.5, 2.0]]])
    path = save_rgb(saver, "it3-0.png", image)
    assert iio.imread(path).tolist() == [[[255, 0, 0], [0, 128, 255]]]
    assert path.endswith("save/it3-0.png")
    path = save_rgb(saver, "deep/er/chw.png", image.permute(2, 0, 1), data_format="CHW")
    assert iio.imread(path).tolist() == [[[255, 0, 0], [0, 128, 255]]]


def test_more_channels_are_laid_side_by_side():
    four = pictures.rgb(np.ones((2, 3, 4)))
    assert four.shape == (2, 6, 3)
    assert four[0, 2].tolist() == [255, 255, 255] and four[0, 5].tolist() == [255, 0, 0]


def test_grayscale_is_stretched_or_kept_and_a_constant_is_black():
    values = np.array([[1.0, 3.0]])
    assert pictures.grayscale(values, cmap=None)[..., 0].tolist() == [[0, 255]]
    assert pictures.grayscale(values, data_range=(0, 4), cmap=None)[..., 0].tolist() == [[64, 191]]
    assert pictures.grayscale(np.full((1, 2), 7.0), cmap=None).max() == 0
    assert pictures.grayscale(np.array([[np.nan, 1.0]]), cmap=None)[..., 0].tolist() == [[0, 255]]
    assert pictures.grayscale(values, cmap="jet")[0].tolist() == [[0, 0, 128], [128, 0, 0]]


def test_a_grid_has_cells_of_one_size_and_rows(saver):
    small = {"type": "rgb", "img": torch.ones(2, 2, 3), "kwargs": {"data_format": "HWC"}}
    kwargs = {"cmap": None, "data_range": (0, 1)}
    large = {"type": "grayscale", "img": torch.eye(4), "kwargs": kwargs}
    assert iio.imread(saver.save_image_grid("row.png", [small, large])).shape == (4, 8, 3)
    rows = saver.save_image_grid("rows.png", [[small, large], [large]])
    assert iio.imread(rows).shape == (8, 8, 3)


def test_a_video_of_odd_pictures_has_even_size_and_numeric_order(saver):
    for i in (10, 2, 1):
        save_rgb(saver, f"it3-test/{i}.png", np.full((33, 17, 3), i / 10))
    path = saver.save_img_sequence("it3-test", "it3-test", r"(\d+)\.png", fps=10)
    frames = iio.imread(path, plugin="FFMPEG")
    assert path.endswith("it3-test.mp4") and frames.shape == (3, 34, 18, 3)
    boxes = Path(path).read_bytes()
    assert boxes.index(b"moov") < boxes.index(b"mdat")  # a browser plays it while it loads
    assert iio.immeta(path, plugin="FFMPEG")["codec"] == "h264"
    assert iio.immeta(path, plugin="FFMPEG")["pix_fmt"].startswith("yuv420p")
    # H.264 rounds colours by a few levels; the order is what counts
    assert np.allclose(frames.mean((1, 2, 3)), [25.5, 51, 255], atol=6)
    gif = saver.save_img_sequence("turn", "it3-test", r"(\d+)\.png", save_format="gif")
    assert len(iio.imread(gif)) == 3


@pytest.mark.parametrize("height", [64, 736])  # without tags players take BT.709 above 720 lines
def test_a_video_is_decoded_to_its_colours_with_the_matrix_that_it_names(saver, height):
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    color = np.array([200, 40, 90])
    for i in range(2):
        save_rgb(saver, f"frames/{i}.png", np.full((height, 64, 3), color / 255))
    path = saver.save_img_sequence("colours", "frames", r"(\d+)\.png", fps=10)
    decode = ["-vf", "scale=in_color_matrix=bt709:in_range=tv", "-pix_fmt", "rgb24"]
    command = [ffmpeg, "-i", path, *decode, "-f", "rawvideo", "-"]
    decoded = subprocess.run(command, capture_output=True, check=True)
    stream = next(x for x in decoded.stderr.decode().splitlines() if "Video: h264" in x)
    assert "(tv, bt709" in stream
    frames = np.frombuffer(decoded.stdout, np.uint8).reshape(2, height, 64, 3)
    assert np.abs(frames.astype(int) - color).max() <= 3


def test_a_video_of_nothing_and_an_unknown_format_are_errors(saver):
    Path(saver.get_save_path("empty/x.txt")).touch()
    with pytest.raises(FileNotFoundError):
        saver.save_img_sequence("a", "empty", r"(\d+)\.png")
    with pytest.raises(UserError, match="unknown video format 'avi'"):
        saver.save_img_sequence("a", "empty", r"(\d+)\.png", save_format="avi")


def test_json_files_and_meshes_are_read_back(saver, tmp_path):
    assert json.loads(Path(saver.save_json("c.json", {"psnr": 30.5})).read_text()) == {"psnr": 30.5}
    (tmp_path / "source.bin").write_bytes(b"abc")
    assert Path(saver.save_file("copy.bin", tmp_path / "source.bin")).read_bytes() == b"abc"
    mesh = SimpleNamespace(**vars(TRIANGLE), v_rgb=torch.ones(3, 3))
    lines = Path(saver.save_obj("m", mesh, save_vertex_color=True)[0]).read_text().splitlines()
    assert lines[0] == "v 1 0 0 1 1 1" and lines[-1] == "f 1 2 3"


@pytest.mark.parametrize(
    ("name", "save"),
    [
        ("a.json", lambda saver, name: saver.save_json(name, {"psnr": 30.5})),
        ("a.bin", lambda saver, name: saver.save_file(name, __file__)),
        ("a.obj", lambda saver, name: saver.save_obj(name, TRIANGLE)[0]),
    ],
)
def test_files_are_replaced_whole_and_links_are_not_followed(saver, tmp_path, name, save):
    """So that neither a full disk nor a link in the folder of results costs an earlier file."""
    (tmp_path / "mine").write_text("mine")
    Path(saver.get_save_path(name)).symlink_to(tmp_path / "mine")
    path = Path(save(saver, name))
    assert (tmp_path / "mine").read_text() == "mine"
    assert path.stat().st_size > 0 and not path.is_symlink()


def test_a_video_in_a_folder_with_a_colon(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pictures.write("0.png", np.zeros((9, 7, 3), np.uint8))
    write_video("runs:1.mp4", [tmp_path / "0.png"] * 2, fps=2)
    assert sorted(os.listdir()) == ["0.png", "runs:1.mp4"]
    with pytest.raises(UserError, match=r"could not be written: [^\n]*$"):
        write_video("no/1.mp4", [tmp_path / "0.png"] * 2, fps=2)
