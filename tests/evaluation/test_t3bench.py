"""T3Bench's folders and cameras."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.clip_similarity_cases import blob
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.evaluation import t3bench
from threestudio_gaussiandreamer.evaluation.clip_similarity import main

register_parts()


def t3bench_pose(v):
    """Return the camera that T3Bench describes: towards the centre, the image's top towards +z, or
    +y near the poles.
    """
    back = v / np.linalg.norm(v)
    up = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, v], axis=1)
    return pose


@pytest.mark.parametrize(("subdivisions", "count"), [(2, 162), (0, 12)])
def test_the_cameras_are_t3benchs(subdivisions, count):
    positions = t3bench.icosphere(subdivisions, t3bench.RADIUS)
    assert len(positions) == count
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 2.2)
    # the poles, where +z can't be up
    assert (np.abs(positions[:, 2]) > 2.19).sum() == (2 if subdivisions else 0)
    found = t3bench.towards_origin(positions).numpy()  # float32
    np.testing.assert_allclose(found, [t3bench_pose(v) for v in positions], atol=2e-6)


def test_the_object_is_centred_and_scaled_without_what_is_invisible():
    arrays = blob(center=(3.0, -1.0, 0.5))
    arrays.means[0], arrays.logit_opacities[0] = 100.0, -8.0
    found = t3bench.normalized(arrays)
    visible = found.means[1:]
    np.testing.assert_allclose(visible.mean(axis=0), 0, atol=1e-5)
    assert np.abs(visible).max() == pytest.approx(1)
    scale = (visible[1] - visible[2])[0] / (arrays.means[2] - arrays.means[3])[0]
    wanted = scale * np.exp(arrays.log_scales)
    np.testing.assert_allclose(np.exp(found.log_scales), wanted, rtol=1e-4)


@pytest.mark.slow
def test_t3benchs_scripts_find_their_pictures(plys, tmp_path, monkeypatch):
    """Makes the folders, and the two calls that T3Bench's scripts make."""
    import trimesh

    prompt, root = "A cat's blue hat", tmp_path / "T3Bench"
    options = ["--t3bench-method", "dreamfusion"]
    monkeypatch.setattr(t3bench, "SIZE", 16)
    assert main([plys[0], "--prompt", prompt, "--t3bench", str(root), *options]) == 0
    runs = root / "outputs_mesh_t3/dreamfusion_single"
    meshes = list(runs.glob(f"{prompt.replace(' ', '_')}*/save/it*-export/model.obj"))
    assert len(meshes) == 1
    mesh = trimesh.load(meshes[0])  # as T3Bench's renderer does
    assert isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 100
    color = mesh.visual.vertex_colors[:, :3].mean(axis=0) / 255
    np.testing.assert_allclose(color, [0.9, 0.1, 0.1], atol=0.01)
    assert not (root / "render").exists()  # T3Bench's own, which draws the mesh
    missing = Path("outputs_mesh_t3/FALSE_PATH")
    for script, count in (("meshrender.py", 162 * 5), ("meshrender_cap.py", 12)):
        for path in (meshes[0], missing):
            folder = tmp_path / f"{script}-{path.name}"
            folder.mkdir()
            arguments = ["--path", str(path), "--name", str(folder)]
            command = [sys.executable, f"render_gaussians/{script}", *arguments]
            subprocess.run(command, check=True, cwd=root, env=os.environ | {"PYTHONPATH": ""})
            assert len(list(folder.iterdir())) == count
            shown = brightness(folder)
            assert (min(shown) > 0) if path is meshes[0] else (max(shown) == 0)
    quality = tmp_path / "meshrender.py-model.obj"
    names = {f"{vertex:03d}_{camera}.png" for vertex in range(162) for camera in range(5)}
    assert {path.name for path in quality.iterdir()} == names
    # a narrower field of view shows the object larger, until it fills the picture
    wide, narrow = (
        np.mean([brightness(quality, f"{vertex:03d}_{camera}.png")[0] for vertex in range(20)])
        for camera in (0, 4)
    )
    assert narrow > 1.2 * wide


def brightness(folder, pattern="*.png"):
    from PIL import Image

    pictures = (Image.open(path).convert("RGB") for path in sorted(folder.glob(pattern)))
    return [float(np.asarray(picture).mean()) for picture in pictures]
