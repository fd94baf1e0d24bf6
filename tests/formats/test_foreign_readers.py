"""Programs of others read what we write, as we read it, and we read what they write.

Each is skipped where it isn't installed: in the folder that VIEWER_NODE_MODULES names the npm
packages @playcanvas/splat-transform, @babylonjs/core, @babylonjs/loaders; from PyPI gaussforge.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.object_clouds import assert_close, ball, in_order_of
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians

MODULES = Path(os.environ.get("VIEWER_NODE_MODULES", "node_modules"))
SCRIPT = MODULES / "@playcanvas/splat-transform/bin/cli.mjs"
OWN_NODE = MODULES / ".bin/node"
NODE = str(OWN_NODE) if OWN_NODE.is_file() else shutil.which("node")
BABYLON = Path(__file__).with_name("glb_by_babylon.mjs")
WRITTEN = ["a.ply", "a.compressed.ply", "3.spz", "4.spz", "a.sog"]
STEPS = {
    "a.compressed.ply": {"means": 2e-3, "log_scales": 1e-3, "opacities": 5e-3, "sh": 0.017},
    "3.spz": {"means": 2e-4, "log_scales": 0.04, "opacities": 5e-3, "sh": 0.08},
    "4.spz": {"means": 2e-4, "log_scales": 0.04, "opacities": 5e-3, "sh": 0.08},
    "a.sog": {"means": 5e-5, "log_scales": 0.03, "opacities": 5e-3, "sh": 0.1, "quats": 1e-4},
    "a.ply": {},
    "a.glb": {},
}
"""Rounding of each format for the cloud of these tests."""


def splat_transform(*arguments):
    if NODE is None or not SCRIPT.is_file():
        pytest.skip(f"no node, or no {SCRIPT}")
    command = [NODE, str(SCRIPT), "-w", "-q", "-g", "cpu", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def write(path, cloud, **options):
    version = int(path.stem) if path.suffix == ".spz" else 3
    write_cloud(str(path), StoredCloud(cloud, "-y", **options), spz_version=version)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("name", WRITTEN)
def test_splat_transform_reads_what_we_write(tmp_path, name, degree):
    """It doesn't turn the axes of any format on the way to a PLY."""
    ours = write(tmp_path / name, ball(300, degree), antialiased=True)
    splat_transform(ours, tmp_path / "theirs.ply")
    theirs, stored = read_cloud(str(tmp_path / "theirs.ply")), read_cloud(str(ours))
    assert theirs.antialiased and stored.antialiased
    close = {"opacities": 2e-3} | ({"sh": 0.02} if name == "a.compressed.ply" else {})
    assert_close(stored.gaussians, theirs.gaussians, **close)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("name", [*WRITTEN[1:], "a.glb"])
def test_we_read_what_splat_transform_writes(tmp_path, name, degree):
    cloud = ball(300, degree)
    source = write(tmp_path / "source.ply", cloud, antialiased=True)
    version = ["--spz-version", name[0]] if name.endswith(".spz") else []
    splat_transform(*version, source, tmp_path / name)
    read = read_cloud(str(tmp_path / name))
    if name == "a.glb":  # the one format whose axes it turns, and without a place for the mode
        assert_close(cloud, read.in_axes("-y").gaussians, sh=1e-5)
        return
    assert read.antialiased
    palette = {"sh": 0.3} if name == "a.sog" and degree else {}  # 256 entries for 300 Gaussians
    assert_close(in_order_of(cloud, read.gaussians), read.gaussians, **STEPS[name] | palette)


@pytest.mark.slow
def test_babylon_reads_our_glb_and_we_read_what_it_makes_of_it(tmp_path):
    """Its loader makes .splat records, so colours and rotations come back as bytes."""
    loaders = MODULES / "@babylonjs/loaders/glTF"
    if NODE is None or not loaders.is_dir():
        pytest.skip(f"no node, or no {loaders}")
    cloud = ball(300, 3)
    write_cloud(str(tmp_path / "a.glb"), StoredCloud(cloud, "y"))
    command = [NODE, str(BABYLON), str(MODULES), str(tmp_path / "a.glb"), str(tmp_path / "a.splat")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = read_cloud(str(tmp_path / "a.splat")).gaussians
    constant = cloud._replace(sh=cloud.sh[:, :1])
    assert_close(constant, found, means=0, opacities=2.1e-3, sh=7.1e-3, quats=1e-3)


def from_gaussforge(ir):
    shapes = {"positions": (-1, 3), "rotations": (-1, 4), "scales": (-1, 3), "alphas": (-1,)}
    values = [np.frombuffer(ir[name], np.float32).reshape(shape) for name, shape in shapes.items()]
    constant = np.frombuffer(ir["colors"], np.float32).reshape(-1, 1, 3)
    rest = np.frombuffer(ir["sh"], np.float32).reshape(len(constant), -1, 3)
    means, quats, scales, alphas = values
    return Gaussians(means, quats, scales, alphas, np.concatenate([constant, rest], axis=1))


@pytest.mark.parametrize("degree", [1, 3])  # its binding for Python fails at degree 0
@pytest.mark.parametrize("name", WRITTEN)
def test_gaussforge_reads_what_we_write(tmp_path, name, degree):
    gaussforge = pytest.importorskip("gaussforge", reason="gaussforge isn't installed")
    path = write(tmp_path / name, ball(300, degree))
    found = gaussforge.GaussForge().read(path.read_bytes(), name.partition(".")[2])
    theirs, ours = from_gaussforge(found["data"]), read_cloud(str(path)).gaussians
    assert_close(in_order_of(ours, theirs), theirs, opacities=2e-3, sh=0.02)
