"""The mesh that the runs of these tests reconstruct."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def painted_box(tmp_path_factory):
    """Write a box whose six sides have six colours, as a GLB."""
    import trimesh

    box = trimesh.creation.box(extents=(1.0, 1.6, 1.2))
    box = box.subdivide().subdivide()
    sides = np.abs(box.face_normals).argmax(1) * 2 + (box.face_normals.max(1) > 0.5)
    palette = "220 40 40 40 200 60 50 80 220 230 210 50 200 60 200 60 210 210"
    palette = np.array(palette.split(), int).reshape(6, 3)
    box.unmerge_vertices()
    box.visual.vertex_colors = np.repeat(palette[sides], 3, axis=0)
    path = tmp_path_factory.mktemp("assets") / "box.glb"
    box.export(path)
    return path
