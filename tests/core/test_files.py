"""Files are written atomically."""

import json
import math

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.files import atomic_file, existing_file, json_text


@pytest.mark.parametrize("name", ["a" * 255, "ü" * 127, "\U0001f98a" * 63], ids=["a", "ü", "fox"])
def test_names_as_long_as_the_file_system_takes(tmp_path, name):
    with atomic_file(tmp_path / name) as file:
        file.write(b"1")
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


def test_a_failure_leaves_the_earlier_file_and_nothing_else(tmp_path):
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"earlier")
    with pytest.raises(UserError, match="An earlier file of this name is untouched"):
        with atomic_file(path) as file:
            file.write(b"half")
            raise OSError(28, "No space left on device")
    assert path.read_bytes() == b"earlier" and list(tmp_path.iterdir()) == [path]


def test_numbers_that_json_does_not_have_are_null():
    content = {"psnr": -math.inf, "curve": [1.5, math.nan, (2, math.inf)], "name": "a"}
    text = json_text(content, indent=1)
    expected = {"psnr": None, "curve": [1.5, None, [2, None]], "name": "a"}
    assert json.loads(text, parse_constant=pytest.fail) == expected


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
        (b"\n<!DOCTYPE html><html><head>", " web page"),
        (b"<html>", " web page"),
    ],
)
def test_what_a_download_left_in_a_files_place_is_named(tmp_path, content, said):
    (tmp_path / "base_40m_textvec.pt").write_bytes(content)
    with pytest.raises(UserError, match=f"^checkpoint '[^']*' is a.*{said}"):
        existing_file(tmp_path / "base_40m_textvec.pt", "checkpoint")
    with pytest.raises(UserError, match="mesh '/dev/null' is no regular file$"):
        existing_file("/dev/null", "mesh")
    with pytest.raises(UserError, match="mesh '~nobodyx/a': not a usable file name"):
        existing_file("~nobodyx/a", "mesh")
