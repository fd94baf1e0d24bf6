"""The name of the bundled models, and messages for files that are missing or damaged."""

import pytest

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.models import bundled
from threestudio_gaussiandreamer.models.bundled import CLIP, DIFFUSION, POINTS, model_part


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The layout of an export, in the place of the bundled one."""
    names = ("stable-diffusion/unet/weights", "clip/weights", "points.safetensors", "training.json")
    for name in (*names, "my notes, für später.txt"):
        path = tmp_path / "bundle" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    bundled.write_digests(tmp_path / "bundle")
    monkeypatch.setattr(bundled, "FOLDER", tmp_path / "bundle")
    bundled.require_intact.cache_clear()
    return tmp_path / "bundle"


def test_the_name_and_the_folder_of_an_export_stand_for_their_parts(folder):
    for part in (DIFFUSION, CLIP, POINTS):
        assert model_part("toybox", part) == model_part(str(folder), part) == str(folder / part)
    others = ("owner/model", "", "x" * 5000, "a\0b", str(folder / "clip"), str(folder.parent))
    assert all(model_part(name, CLIP) == name for name in others)
    assert {"training.json", "my notes, für später.txt"} <= bundled.read_digests(folder).keys()
    line = (folder / "SHA256SUMS").read_text().splitlines()[-1]  # as of sha256sum
    assert line.endswith("  training.json") and len(line.split()[0]) == 64


@pytest.mark.parametrize("is_bundled", [True, False])
@pytest.mark.parametrize("content", [None, "other"])
def test_a_damaged_file_is_named_with_how_to_get_it_again(folder, monkeypatch, content, is_bundled):
    weights = folder / "stable-diffusion/unet/weights"
    weights.write_text(content) if content else weights.unlink()
    if not is_bundled:
        monkeypatch.setattr(bundled, "FOLDER", folder / "elsewhere")
    name = "toybox" if is_bundled else str(folder)
    remedy = "install.*git checkout" if is_bundled else "write the folder again"
    refused(f"unet/weights' is missing or damaged: {remedy}", model_part, name, DIFFUSION)
    assert model_part(name, CLIP)  # the other parts can be used
    if not is_bundled:
        assert model_part(name, "another")  # an export needn't have all parts
        bundled.require_intact.cache_clear()
        (folder / "SHA256SUMS").unlink()
        assert model_part(name, DIFFUSION)


@pytest.mark.parametrize("part", [CLIP, POINTS])
@pytest.mark.parametrize("content", [None, b"", b"a\n", b"\xff\x00\x80\n", b"0" * 64 + b"\n"])
def test_without_the_list_or_with_a_damaged_one_nothing_is_used(folder, monkeypatch, content, part):
    digests = folder / "SHA256SUMS"
    digests.unlink() if content is None else digests.write_bytes(content)
    said = f"{part}' is missing or damaged: "
    refused(f"{said}install the package again", model_part, "toybox", part)
    if content is not None:
        monkeypatch.setattr(bundled, "FOLDER", folder / "elsewhere")
        refused(f"{said}write the folder again", model_part, str(folder), part)
