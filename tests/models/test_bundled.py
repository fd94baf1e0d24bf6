"""The name of the bundled models, and messages for files that are missing or damaged."""

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.models import bundled
from threestudio_gaussiandreamer.models.bundled import CLIP, DIFFUSION, POINTS, model_part


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The layout of an export, in the place of the bundled one."""
    for name in (
        "stable-diffusion/unet/weights",
        "clip/weights",
        "points.safetensors",
        "training.json",
    ):
        path = tmp_path / "bundle" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    bundled.write_digests(tmp_path / "bundle")
    monkeypatch.setattr(bundled, "FOLDER", tmp_path / "bundle")
    return tmp_path / "bundle"


@pytest.mark.parametrize("part", [DIFFUSION, CLIP, POINTS])
def test_the_name_and_the_folder_of_an_export_stand_for_their_parts(folder, part):
    assert model_part("toybox", part) == model_part(str(folder), part) == str(folder / part)


def test_other_names_are_unchanged(folder):
    others = ("owner/model", "", "x" * 5000, "a\0b", str(folder / "clip"), str(folder.parent))
    assert all(model_part(name, CLIP) == name for name in others)


def test_the_list_of_digests_is_that_of_sha256sum(folder):
    line = (folder / "SHA256SUMS").read_text().splitlines()[1]
    assert line.endswith("  points.safetensors") and len(line.split()[0]) == 64
    assert "training.json" in (folder / "SHA256SUMS").read_text()


def test_a_damaged_file_is_named_with_how_to_install_it_again(folder):
    (folder / "stable-diffusion/unet/weights").write_text("other")
    with pytest.raises(UserError, match="unet/weights' is damaged: install.*git checkout"):
        model_part("toybox", DIFFUSION)
    assert model_part("toybox", CLIP)  # the other parts can be used


def test_a_missing_file_is_named(folder):
    (folder / "points.safetensors").unlink()
    with pytest.raises(
        UserError, match="points.safetensors': No such file.*install the package again"
    ):
        model_part("toybox", POINTS)


@pytest.mark.parametrize("part", [CLIP, "another"])
def test_without_the_list_or_the_part_the_package_is_to_be_installed_again(folder, part):
    if part == CLIP:
        (folder / "SHA256SUMS").unlink()
    with pytest.raises(UserError, match="(SHA256SUMS|another)' is missing: install the package"):
        model_part("toybox", part)


@pytest.mark.parametrize("content", [b"abc\n", b"\xff\x00\x80\n", b"0" * 64 + b"\n"])
def test_a_damaged_list_of_digests_is_named(folder, content):
    (folder / "SHA256SUMS").write_bytes(content)
    with pytest.raises(UserError, match="SHA256SUMS' is damaged: install the package again"):
        model_part("toybox", CLIP)


def test_other_files_of_a_folder_may_have_any_names(folder, monkeypatch):
    """An export lists those that its folder had before."""
    monkeypatch.setattr(bundled, "FOLDER", folder / "elsewhere")
    (folder / "my notes, für später.txt").write_text("a")
    bundled.write_digests(folder)
    assert "my notes, für später.txt" in bundled.read_digests(folder)
    assert model_part(str(folder), CLIP) == str(folder / CLIP)


def test_damaged_files_of_an_export_are_named_unless_it_has_no_digests(folder, monkeypatch):
    monkeypatch.setattr(bundled, "FOLDER", folder / "elsewhere")
    (folder / "clip/weights").write_text("other")
    with pytest.raises(UserError, match="clip/weights' is damaged: write the folder again"):
        model_part(str(folder), CLIP)
    assert model_part(str(folder), "another")  # an export needn't have all parts
    (folder / "SHA256SUMS").unlink()
    assert model_part(str(folder), CLIP)
