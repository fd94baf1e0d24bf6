"""SOG files: laid out as published, close to what was stored; bombs and damage are refused."""

import io
import json
import struct
import zipfile

import numpy as np
import pytest
from PIL import Image

from tests.helpers.memory import memory_below
from tests.helpers.object_clouds import ball
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import gaussian_files, sog
from threestudio_gaussiandreamer.formats.packing import ANTIALIASED


def read_sog(path):
    return sog.read_sog(path)[0]


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def repacked(path, packing=zipfile.ZIP_STORED, **changes):
    """The file with members replaced, or dropped where they are None; meta is updated."""
    content = members(path)
    meta = json.loads(content["meta.json"]) | changes.pop("meta", {})
    content["meta.json"] = json.dumps(meta).encode()
    content |= {name.replace("__", "."): value for name, value in changes.items()}
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, value in content.items():
            if value is not None:
                archive.writestr(name, value)
    return path


def image(size, lossless=True, frames=1, mode="RGBA"):
    buffer, picture = io.BytesIO(), Image.new(mode, size)
    more = {"save_all": True, "append_images": [Image.new(mode, size, 9)]} if frames > 1 else {}
    picture.save(buffer, "WEBP", lossless=lossless, **more)
    return buffer.getvalue()


FILES, PALETTE = ["means_l.webp", "means_u.webp"], ["shN_centroids.webp", "shN_labels.webp"]
NO_PALETTE = {"bands": 1, "count": 0, "codebook": [0] * 256, "files": PALETTE}


@pytest.fixture
def path(tmp_path):
    sog.write_sog(tmp_path / "a.sog", ball(50, 1), notes=["pruned to the likeness, dB: 40"])
    return tmp_path / "a.sog"


def test_the_images_are_laid_out_as_published_and_their_names_lead_nowhere(path, tmp_path):
    """Decoded by Pillow, by the formulas of the specification; mode and notes are kept."""
    sog.write_sog(tmp_path / "b.sog", ball(9), [ANTIALIASED, "one", "two"])
    assert sog.read_sog(tmp_path / "b.sog")[1] == ["one", "two", ANTIALIASED]
    assert json.loads(members(tmp_path / "b.sog")["meta.json"])["model"] == "antialiased"
    content, read = members(path), read_sog(path)
    meta = json.loads(content["meta.json"])
    pixels = {
        name: np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"), np.int64).reshape(-1, 4)[:50]
        for name, data in content.items()
        if name.endswith("l.webp") or name in ("means_u.webp", "quats.webp", "sh0.webp")
    }
    steps = pixels["means_u.webp"][:, :3] << 8 | pixels["means_l.webp"][:, :3]
    low, high = (np.array(meta["means"][key]) for key in ("mins", "maxs"))
    logs = low + (high - low) * steps / 65535
    np.testing.assert_allclose(read.means, np.sign(logs) * (np.exp(np.abs(logs)) - 1), atol=1e-6)
    book = np.array(meta["sh0"]["codebook"])
    np.testing.assert_allclose(read.sh[:, 0], book[pixels["sh0.webp"][:, :3]], atol=1e-6)
    tags = pixels["quats.webp"][:, 3]
    assert ((tags >= 252) & (tags <= 255)).all() and len(set(tags)) == 4
    assert (meta["count"], meta["version"]) == (50, 2)
    means = members(path)["means_l.webp"]
    name = "../../outside.webp"
    meta = json.loads(members(path)["meta.json"])
    meta["means"]["files"][0] = name
    before = read_sog(path)
    read = read_sog(repacked(path, meta=meta, **{name: means}))
    np.testing.assert_array_equal(read.means, before.means)
    assert not list(tmp_path.parent.glob("**/outside.webp"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"meta": {"count": 10**9}}, "1000000000 Gaussians would take .* of memory"),
        ({"meta": {"count": 70}}, "has 64 pixels, too few for 70 Gaussians"),
        ({"meta": {"count": -1}}, "count should be 0 or more"),
        ({"meta": {"version": 3}}, "it is of version 3; version 1 or 2 was expected"),
        ({"meta": {"means": None}}, "damaged"),
        ({"meta": {"sh0": {"codebook": [0.0] * 255, "files": ["sh0.webp"]}}}, "256 numbers"),
        ({"meta": {"quats": {"files": []}}}, "damaged"),
        ({"meta": {"quats": {"files": ["sh0.webp"]}}}, "names no largest component"),
        ({"meta": {"means": {"mins": [0, 0, np.nan], "maxs": [1] * 3, "files": FILES}}}, "mins"),
        ({"meta": {"shN": {"bands": 4}}}, "harmonics of degree 4"),
        ({"quats__webp": None}, "no item named 'quats.webp'"),
        ({"meta__json": b"{"}, "JSON"),
        ({"meta__json": b"[" * 100_000}, "RecursionError"),
        ({"sh0__webp": b"RIFF"}, "damaged"),
        ({"sh0__webp": image((8, 8), lossless=False, mode="RGB")}, "isn't a lossless WebP"),
        ({"sh0__webp": image((8, 8), frames=2)[:-9]}, "damaged"),
        ({"sh0__webp": image((4, 4))}, "16 pixels, too few for 50 Gaussians"),
        ({"shN_centroids__webp": image((8, 8))}, "palette of 50 entries can't have 8 x 8"),
        ({"shN_labels__webp": image((8, 8)), "meta": {"shN": NO_PALETTE}}, "damaged"),
    ],
    ids=range(19),
)
def test_damaged_files_are_refused(path, changes, said):
    refused(said, read_sog, repacked(path, **changes))


def test_bombs_cost_no_memory_and_what_is_no_archive_is_refused(path):
    """In the archive, as JSON, and a lossless image of one colour, 16383 x 16383, of few bytes."""
    data = bytearray(path.read_bytes())
    bits = 16382 | 16382 << 14 | 1 << 28
    body = b"VP8L" + struct.pack("<IBI", 20, 0x2F, bits) + bytes(15)
    image = b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body
    bombs = [
        ({"sh0__webp": bytes(9_000_000)}, "'sh0.webp' has more than"),
        ({"sh0__webp": image}, "a.sog': .*(16383 x 16383|damaged)"),
        ({"meta__json": b" " * 9_000_000}, "'meta.json' has more than"),
    ]
    for changes, said in bombs:
        repacked(path, zipfile.ZIP_DEFLATED, **changes)
        with memory_below(4 << 20), pytest.raises(UserError, match=said):
            read_sog(path)
    data[data.index(b"WEBPVP8L") + 40] ^= 1  # seen by the checksum
    no_zip = "a.sog': .*not a zip file"
    contents = [(bytes(data), "CRC"), (b"", no_zip), (b"PK\x03\x04", no_zip), (bytes(99), no_zip)]
    for content, said in contents:
        path.write_bytes(content)
        refused(said, read_sog, path)


def unpacked(path, folder, version=2):
    """The file as a folder, in version 1 with mins and maxs in place of codebooks."""
    content = members(path)
    meta = json.loads(content["meta.json"])
    if version == 1:
        count, high = meta.pop("count"), {"sh0": 2.0, "scales": -1.0}
        del meta["version"]
        meta["means"]["shape"] = [count, 3]
        for key, channels in (("sh0", 4), ("scales", 3)):
            files = meta[key]["files"]
            meta[key] = {"mins": [-3] * channels, "maxs": [high[key]] * channels, "files": files}
        meta["shN"] = {"mins": -0.5, "maxs": 0.5, "files": meta["shN"]["files"]}
    folder.mkdir(exist_ok=True)
    for name, data in (content | {"meta.json": json.dumps(meta).encode()}).items():
        (folder / name).write_bytes(data)
    return folder / "meta.json"


def test_folders_are_read_by_their_json_also_in_an_archive_and_with_png(path, tmp_path):
    """PNG as glTF-Transform converts them; a folder that was zipped by hand."""
    file, stored = unpacked(path, tmp_path / "folder"), read_sog(path)
    read = gaussian_files.read_cloud(str(file))
    assert all(np.array_equal(a, b) for a, b in zip(read.gaussians, stored, strict=True))
    assert (read.up, read.pruned_to) == ("-y", 40)
    refused("is a folder, .* give the meta.json in it", gaussian_files.read_cloud, str(file.parent))
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        for member in (*file.parent.glob("*.webp"), file):
            archive.write(member, f"scene/{member.name}")
    for picture in file.parent.glob("*.webp"):
        with Image.open(picture) as image:
            image.convert("RGBA").save(picture.with_suffix(".png"))
        picture.unlink()
    file.write_text(file.read_text().replace(".webp", ".png"))
    for read in (read_sog(file), read_sog(tmp_path / "b.sog")):
        assert all(np.array_equal(a, b) for a, b in zip(read, stored, strict=True))


def test_version_1_is_read(path, tmp_path):
    """Steps between mins and maxs, by the formulas of PlayCanvas' reader of version 1."""
    file = unpacked(path, tmp_path / "folder", 1)
    read, stored = read_sog(file), read_sog(path)
    np.testing.assert_array_equal(read.means, stored.means)
    np.testing.assert_array_equal(read.quats, stored.quats)

    def pixels(name):
        with Image.open(file.with_name(name)) as picture:
            return np.asarray(picture.convert("RGBA"), np.float64)

    colors = -3 + 5 * pixels("sh0.webp").reshape(-1, 4)[:50] / 255
    scales = -3 + 2 * pixels("scales.webp").reshape(-1, 4)[:50, :3] / 255
    palette = pixels("shN_centroids.webp")[..., :3].reshape(-1, 3, 3) / 255 - 0.5
    labels = pixels("shN_labels.webp").reshape(-1, 4)[:50, 0].astype(int)
    np.testing.assert_allclose(read.log_scales, scales, atol=1e-6)
    np.testing.assert_allclose(read.sh[:, 0], colors[:, :3], atol=1e-6)
    np.testing.assert_allclose(read.logit_opacities, colors[:, 3], atol=1e-6)
    np.testing.assert_allclose(read.sh[:, 1:], palette[labels], atol=1e-6)


@pytest.mark.parametrize(
    ("section", "value", "said"),
    [
        ("means", {"files": FILES}, "count should be 0 or more, not None"),
        ("scales", {"mins": [0], "maxs": [1], "files": ["scales.webp"]}, "mins of scales"),
        ("sh0", {"files": ["../folder/sh0.webp"]}, "Invalid name"),
        ("shN", {"files": ["sh0.webp"]}, "damaged"),
    ],
)
def test_damaged_folders_are_refused(path, tmp_path, section, value, said):
    file = unpacked(path, tmp_path / "folder", 1)
    file.write_text(json.dumps(json.loads(file.read_text()) | {section: value}))
    refused(said, read_sog, file)


def test_many_values_are_kept_better_than_by_equal_steps():
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32) ** 3
    book, rows = sog.scalar_codebook(values)
    steps = np.linspace(values.min(), values.max(), 256)
    equal = steps[np.abs(values[:, None] - steps).argmin(1)]
    assert ((book[rows] - values) ** 2).mean() < 0.2 * ((equal - values) ** 2).mean()
