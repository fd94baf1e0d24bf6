"""Parts, simplification and touching parts of closed meshes."""

import numpy as np
import pytest
import trimesh

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.surface import closed


def ball(radius=1.0, subdivisions=3, place=(0, 0, 0)):
    found = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return found.vertices + place, found.faces


def joined(*parts):
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [part[1] + start for part, start in zip(parts, starts, strict=False)]
    return np.concatenate([part[0] for part in parts]), np.concatenate(faces)


def welded(vertices, faces):
    positions, rows = np.unique(vertices, axis=0, return_inverse=True)
    return positions, rows.reshape(-1)[faces]


def two_boxes(offset):
    box = trimesh.creation.box()
    return welded(*joined((box.vertices, box.faces), (box.vertices + offset, box.faces)))


def test_small_parts_and_folds_are_dropped_and_what_cant_be_closed_is_refused():
    vertices, faces = ball(subdivisions=2)
    cavity = ball(0.5, 2)[0], ball(0.5, 2)[1][:, ::-1]
    three = joined(ball(0.05, 1, (2, 0, 0)), cavity, (vertices, faces))
    kept = closed.without_small_parts(*three, 0.01)
    np.testing.assert_array_equal(kept[0], vertices)
    np.testing.assert_array_equal(kept[1], faces)
    assert kept[2] == 1  # a cavity can't be seen

    for radius, dropped in ((0.5, 0), (0.11, 0), (0.095, 1)):
        two = joined(ball(), ball(radius, 2, (2, 0, 0)))
        _, faces, count = closed.without_small_parts(*two, 0.01)
        assert count == dropped and (len(faces) == len(two[1])) == (not dropped)
    _, faces = ball(subdivisions=1)
    kept = closed.without_folds(np.concatenate([faces, [[90, 91, 92], [92, 91, 90], [3, 3, 4]]]))
    np.testing.assert_array_equal(kept, faces)
    vertices, faces = ball(subdivisions=1)
    again = closed.simplified(vertices, faces, 5000)
    assert len(again[1]) == len(faces) and closed.is_closed(again[1])
    np.testing.assert_allclose(np.sort(again[0], axis=0), np.sort(vertices, axis=0))
    parts = joined(*(ball(subdivisions=1, place=(3 * k, 0, 0)) for k in range(60)))
    refused("can't be closed with 100 faces", closed.simplified, *parts, 100)
    refused("closed with 5000 faces", closed.simplified, vertices, faces[1:], 5000)  # with a hole


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
def test_simplified_meshes_stay_closed_and_keep_their_size_at_any_scale(factor):
    vertices, faces = ball()
    plain = closed.simplified(vertices, faces, 300)
    scaled = closed.simplified(factor * vertices, faces, 300)
    np.testing.assert_array_equal(scaled[0] / factor, plain[0])
    np.testing.assert_array_equal(scaled[1], plain[1])
    for vertices, faces in (plain, closed.simplified(*ball(), 100)):
        assert len(faces) <= 300 and closed.is_closed(faces)
        found = trimesh.Trimesh(vertices, faces, process=False)
        assert found.volume == pytest.approx(4.12, rel=0.08)


def test_boxes_that_share_an_edge_or_a_corner_are_separated():
    vertices, faces = two_boxes([1, 1, 0])
    assert not closed.is_closed(faces)
    moved, apart = closed.separated(vertices, faces)
    assert closed.is_closed(apart) and closed.is_closed(welded(moved, apart)[1])
    parts = trimesh.Trimesh(moved, apart, process=False).split()
    assert len(parts) == 2
    assert all(part.volume == pytest.approx(1, abs=0.1) for part in parts)
    moved, apart = closed.separated(*two_boxes(1))
    assert len(moved) == 16 and len(np.unique(moved, axis=0)) == 16 and closed.is_closed(apart)


def cells_to_mesh(cells):
    """Return the faces between filled and empty cells of a grid, two triangles each."""
    padded = np.pad(cells, 1)
    faces, corners = [], []
    for axis in range(3):
        for sign in (-1, 1):
            open_side = padded & ~np.roll(padded, -sign, axis)
            for cell in np.argwhere(open_side):
                u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
                first = cell + (sign > 0) * np.eye(3, dtype=int)[axis]
                ring = [first, first + u, first + u + v, first + v][::sign]
                start = len(corners)
                corners += ring
                faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return welded(np.array(corners, float), np.array(faces))


def test_cells_that_touch_at_an_edge_and_random_ones_are_closed():
    """A ring of cells whose ends touch at one edge only, so that its ends have one fan each."""
    cells = np.zeros((3, 3, 1), bool)
    cells[[0, 0, 0, 1, 2, 2], [0, 1, 2, 2, 2, 1]] = True
    cells[1, 0] = True  # touches (2, 1) at an edge
    vertices, faces = cells_to_mesh(cells)
    assert not closed.is_closed(faces)
    moved, apart = closed.separated(vertices, faces)
    assert closed.is_closed(welded(moved, apart)[1])
    volume = trimesh.Trimesh(moved, apart, process=False).volume
    assert volume == pytest.approx(cells.sum(), rel=0.05)
    for seed in range(3):
        cells = np.random.default_rng(seed).random((5, 5, 5)) < 0.4
        moved, apart = closed.separated(*cells_to_mesh(cells))
        assert closed.is_closed(welded(moved.astype(np.float32), apart)[1])
