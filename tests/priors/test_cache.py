"""The prior runs once per (prior, options, their files, prompt, seed) and folder."""

import importlib.util
import os
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from PIL import Image

from threestudio_gaussiandreamer.formats.ply import read_points
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import BaseObject
from threestudio_gaussiandreamer.priors.cache import cache_key, cached_cloud
from threestudio_gaussiandreamer.priors.mesh import MeshPrior


class CountingPrior(BaseObject):
    calls = 0

    @dataclass
    class Config(BaseObject.Config):
        size: float = 1.0
        source: str = ""

    def __call__(self, prompt):
        type(self).calls += 1
        points = np.random.default_rng(0).random((10, 3)).astype(np.float32) * self.cfg.size
        return PointCloud(points, points / self.cfg.size)


def test_the_prior_runs_again_for_another_prompt_option_seed_or_a_damaged_file(
    tmp_path, monkeypatch
):
    CountingPrior.calls = 0
    first = cached_cloud(CountingPrior({}), "a fox", tmp_path)
    again = cached_cloud(CountingPrior({}), "a fox", tmp_path)
    assert CountingPrior.calls == 1 and again.normals is None
    np.testing.assert_array_equal(np.stack(first[:2]), np.stack(again[:2]))
    path = tmp_path / "prior" / "points.npz"
    assert len(read_points(path.with_suffix(".ply")).points) == 10
    path.write_bytes(path.read_bytes()[:50])
    cached_cloud(CountingPrior({}), "a fox", tmp_path)
    cached_cloud(CountingPrior({}), "a fox", None)  # no folder: no cache
    cached_cloud(CountingPrior({}), "a dog", tmp_path)
    cached_cloud(CountingPrior({"size": 2.0}), "a dog", tmp_path)
    monkeypatch.setenv("PL_GLOBAL_SEED", "3")
    cached_cloud(CountingPrior({"size": 2.0}), "a dog", tmp_path)
    assert CountingPrior.calls == 6


def test_a_changed_file_runs_the_prior_again(tmp_path):
    """A mesh that was mended, or weights in a folder that were replaced."""
    (tmp_path / "models").mkdir()
    file = tmp_path / "models" / "a.ply"
    for source in (file, tmp_path / "models"):
        file.write_text("red")
        CountingPrior.calls, folder = 0, tmp_path / f"save {source.name}"
        for text in ("red", "red", "redder"):
            if file.read_text() != text:
                file.write_text(text)
            cached_cloud(CountingPrior({"source": str(source)}), "a fox", folder)
        os.utime(file, ns=(1, 1))  # as long as before
        cached_cloud(CountingPrior({"source": str(source)}), "a fox", folder)
        assert CountingPrior.calls == 3
    for text in ("grey", "", "no\0name", "~no-such-user/x", 300 * "x"):  # no files
        prior = CountingPrior({"source": text})
        assert cache_key(prior, "") == cache_key(prior, "")


def test_a_changed_texture_beside_a_mesh_runs_the_prior_again(tmp_path, monkeypatch):
    """Also one that was missing, and one that a material file names."""
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd textures/t.png\n")
    (tmp_path / "textures").mkdir()
    colors, prior = [], MeshPrior({"path": str(tmp_path / "a.obj")})
    for shade in (None, 40, 200, 200):
        if shade is not None:
            image = Image.new("RGB", (1, 1), (shade, 0, 0))
            image.save(tmp_path / "textures" / "t.png")
            os.utime(tmp_path / "textures" / "t.png", ns=(shade, shade))
        colors.append(cached_cloud(prior, "a fox", tmp_path / "save").colors[0, 0] * 255)
    np.testing.assert_allclose(colors, [127.5, 40, 200, 200], atol=0.5)
    monkeypatch.setattr(MeshPrior, "generate", lambda self, prompt, generator: pytest.fail())
    cached_cloud(prior, "a fox", tmp_path / "save")


def test_changed_code_runs_the_prior_again(tmp_path):
    """Of a file, and of another file of the same package."""
    path, other = tmp_path / "own.py", tmp_path / "shapes.py"
    code = f"from {__name__} import CountingPrior\nclass Own(CountingPrior):\n    pass\n"

    def key_of(text: str, other_text: str) -> str:
        path.write_text(text)
        other.write_text(other_text)
        spec = importlib.util.spec_from_file_location("parts_of_a_user", path)
        module = importlib.util.module_from_spec(spec)
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, spec.name, module)
            spec.loader.exec_module(module)
            return cache_key(module.Own({}), "")

    keys = [key_of(*texts) for texts in ((code, "1"), (code, "2"), (f"{code}# other\n", "2"))]
    assert keys[0] == keys[1] != keys[2]
    (tmp_path / "__init__.py").touch()
    keys += [key_of(f"{code}# other\n", "2"), key_of(f"{code}# other\n", "3")]
    assert len(set(keys)) == 4
