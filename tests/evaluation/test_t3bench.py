"""T3Bench's folders and cameras."""

import numpy as np
import pytest

from tests.evaluation.conftest import blob
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.evaluation import t3bench
from threestudio_gaussiandreamer.evaluation.clip_similarity import main

register_parts()


def t3bench_pose(v):
    """Return T3Bench's camera: towards the centre, +z up, or +y near the poles."""
    back = v / np.linalg.norm(v)
    up = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, v], axis=1)
    return pose


def test_the_cameras_are_t3benchs_and_the_object_is_centred_and_scaled(monkeypatch):
    monkeypatch.setattr(t3bench, "SIZE", 8)
    drawn = []
    monkeypatch.setattr(t3bench, "render_views", lambda _, *views, **how: drawn.extend(views))
    t3bench.pictures(blob())
    positions = drawn[0][::5, :3, 3].numpy()
    assert drawn[0].shape == (810, 4, 4) and drawn[2] == 8
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 2.2, rtol=1e-6)
    assert (np.abs(positions[:, 2]) > 2.19).sum() == 2  # the poles, where +z can't be up
    poses = np.repeat([t3bench_pose(v) for v in positions], 5, 0)
    np.testing.assert_allclose(drawn[0], poses, atol=2e-6)
    np.testing.assert_allclose(drawn[1][:10].reshape(2, 5), [t3bench.FOVY] * 2)
    arrays = blob(center=(3.0, -1.0, 0.5))
    arrays.means[0], arrays.logit_opacities[0] = 100.0, -8.0
    found = t3bench.normalized(arrays)
    visible = found.means[1:]
    np.testing.assert_allclose(visible.mean(axis=0), 0, atol=1e-5)
    assert np.abs(visible).max() == pytest.approx(1)
    scale = (visible[1] - visible[2])[0] / (arrays.means[2] - arrays.means[3])[0]
    wanted = scale * np.exp(arrays.log_scales)
    np.testing.assert_allclose(np.exp(found.log_scales), wanted, rtol=1e-4)


def test_t3benchs_scripts_find_their_mesh(plys, tmp_path):
    import trimesh

    prompt, root = "A cat's blue hat", tmp_path / "T3Bench"
    options = ["--t3bench-method", "dreamfusion"]
    assert main([plys[0], "--prompt", prompt, "--t3bench", str(root), *options]) == 0
    runs = root / "outputs_mesh_t3/dreamfusion_single"
    (path,) = runs.glob(f"{prompt.replace(' ', '_')}*/save/it*-export/model.obj")
    mesh = trimesh.load(path)  # as T3Bench's renderer does
    assert isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 100
    color = mesh.visual.vertex_colors[:, :3].mean(axis=0) / 255
    np.testing.assert_allclose(color, [0.9, 0.1, 0.1], atol=0.01)
