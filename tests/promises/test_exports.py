"""What is exported from one checkpoint stays the same, byte for byte.

``data/exports.json`` has a digest for each file that ``--export`` writes from ``data/run``; of
compressed files it is of the content, since compressors differ between machines. To add a format,
add the digest that the failing test prints.
"""

import gzip
import hashlib
import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from threestudio_gaussiandreamer.formats.gaussian_files import read_cloud

from .commands import DATA, command, launch

DIGESTS = json.loads((DATA / "exports.json").read_text())
FORMATS = "system.exporter.formats=[ply,compressed-ply,spz,sog,glb,usda,points]"
NEXT = {
    "spz4/gaussians.spz": ["spz-exporter", "version=4"],
    "padded/gaussians.ply": ["ply-exporter", "pad_sh_degree=3"],
    "z/gaussians.ply": ["ply-exporter", "up=z"],
}
"""Files of a single exporter, with an option."""


def content(path: Path) -> bytes:
    """Return what a file holds, without its compression."""
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        return gzip.decompress(data)
    if data[:4] == b"NGSP":  # SPZ 4: zstd
        arrays = read_cloud(str(path)).gaussians
        return b"".join(np.asarray(array).tobytes() for array in arrays)
    if data[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = {name: archive.read(name) for name in sorted(archive.namelist())}
        return b"".join(
            name.encode() + (pixels(part) if name.endswith(".webp") else part)
            for name, part in parts.items()
        )
    return data


def pixels(data: bytes) -> bytes:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).tobytes()


def digest(path: Path) -> str:
    return hashlib.sha256(content(path)).hexdigest()[:32]


@pytest.fixture(scope="session")
def exported(tmp_path_factory) -> Path:
    """Return the folder of all exports of the earlier run."""
    root = tmp_path_factory.mktemp("exports")
    run = ["--config", DATA / "run/configs/parsed.yaml", "--export"]
    run += [f"resume={DATA}/run/ckpts/last.ckpt", f"exp_root_dir={root}", "system.pages=false"]
    assert launch(*run, "tag=all", FORMATS).code == 0
    for name, (exporter, option) in NEXT.items():
        tag = name.partition("/")[0]
        options = [f"system.exporter_type={exporter}", f"system.exporter.{option}", f"tag={tag}"]
        if (result := launch(*run, *options)).code:
            pytest.importorskip("zstandard")
            raise AssertionError(result.err)
    return root / "smoke"


@pytest.mark.parametrize("name", DIGESTS)
def test_an_export_is_the_same_byte_for_byte(exported, name):
    tag, _, file = name.partition("/")
    path = exported / tag / "save/it8-export" / file
    if name.startswith("spz4"):
        import zstandard  # noqa: F401
    assert digest(path) == DIGESTS[name], f"{name} differs, or its digest is new: {digest(path)}"


def test_nothing_else_is_exported(exported):
    found = {
        f"{path.parts[-4]}/{path.name}"
        for path in exported.glob("*/save/it8-export/*")
        if path.suffix not in {".png", ".html"}
    }
    assert found == set(DIGESTS)


def test_exports_of_one_cloud_agree(exported):
    """Each is read back; rounding formats within their rounding."""
    folder = exported / "all/save/it8-export"
    exact = read_cloud(str(folder / "gaussians.ply")).in_axes("z").gaussians
    for name in ("compressed.ply", "spz", "sog", "glb", "usda"):
        found = read_cloud(str(folder / f"gaussians.{name}")).in_axes("z").gaussians
        assert len(found.means) == 48 and found.sh_degree == 1
        nearest = np.abs(found.means[:, None] - exact.means[None]).sum(-1).min(1)
        assert nearest.max() < 5e-3


def test_a_ply_is_converted_without_loss(exported):
    source = exported / "all/save/it8-export/gaussians.ply"
    assert command("convert", source, "a.ply").code == 0
    before, after = (read_cloud(str(path)).gaussians for path in (source, "a.ply"))
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))


def test_a_cloud_becomes_a_mesh():
    pytest.importorskip("skimage")
    small = ["--faces", "200", "--texture", "64", "--views", "8", "--view-size", "64"]
    source = DATA.parents[1] / "data/earlier/gaussians.ply"
    result = command("convert", source, "mesh.glb", *small, "--resolution", "32")
    assert result.code == 0 and Path("mesh.glb").read_bytes()[:4] == b"glTF", result.err
