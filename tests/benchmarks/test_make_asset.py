"""The script of the bundled mesh still generates it, and rejects what does not fit into the
texture.
"""

import numpy as np
import pytest

from benchmarks.scenes import make_asset
from threestudio_gaussiandreamer.meshes.load import load_mesh


def test_the_script_makes_the_bundled_mesh(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["make_asset.py", str(tmp_path / "made.glb")])
    make_asset.main()
    made, bundled = load_mesh(tmp_path / "made.glb"), load_mesh(make_asset.DEFAULT)
    assert np.array_equal(made.faces, bundled.faces)
    np.testing.assert_allclose(made.vertices, bundled.vertices, atol=1e-6)
    chunks = [path.read_bytes() for path in (tmp_path / "made.glb", make_asset.DEFAULT)]
    assert abs(len(chunks[0]) - len(chunks[1])) < 0.01 * len(chunks[1])  # the texture's PNG


def test_parts_that_exceed_the_texture_are_refused():
    with pytest.raises(ValueError, match="the parts need 600 rows of texels, there are 512"):
        make_asset.pack([(512, 300), (512, 300)])
