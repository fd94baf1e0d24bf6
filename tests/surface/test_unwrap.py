"""Texture coordinates: within the texture, without texels that two faces share."""

import numpy as np
import pytest
import trimesh

from threestudio_gaussiandreamer.surface.bake import (
    SMALLEST_CELL,
    XATLAS_FACES,
    faces_that_fit,
    in_charts,
    in_grid,
    unwrap,
)

BALL = trimesh.creation.icosphere(subdivisions=2)


def texels_of(corners, size):
    """Return the texels that bilinear lookup touches at many places of a triangle."""
    weights = np.random.default_rng(0).dirichlet([0.4] * 3, 400)
    places = np.concatenate([np.eye(3), weights]) @ corners * size - 0.5
    first = np.floor(places + 1e-9).astype(int)
    right, down = np.ceil(places - 1e-9).astype(int).T
    columns, rows = first.T
    return {*zip(columns, rows, strict=True), *zip(right, rows, strict=True)} | {
        *zip(columns, down, strict=True),
        *zip(right, down, strict=True),
    }


@pytest.mark.parametrize("method", [in_charts, in_grid])
def test_faces_keep_their_corners_and_lie_in_the_texture(method):
    found = method(BALL.vertices, BALL.faces, 128)
    assert 0 <= found.uv.min() and found.uv.max() <= 1
    corners = np.sort(found.rows[found.faces], axis=1)
    np.testing.assert_array_equal(corners, np.sort(BALL.faces, axis=1))
    before, after = (
        trimesh.Trimesh(vertices, faces, process=False).volume
        for vertices, faces in (
            (BALL.vertices, BALL.faces),
            (BALL.vertices[found.rows], found.faces),
        )
    )
    assert after == pytest.approx(before)  # the orientation is kept too


def test_triangles_of_the_grid_share_no_texel():
    size = 2 * SMALLEST_CELL * 7
    found = in_grid(BALL.vertices, BALL.faces[:90], size)
    owners = {}
    for face, corners in enumerate(found.uv[found.faces]):
        for texel in texels_of(corners, size):
            assert owners.setdefault(texel, face) == face
    assert {0 <= x < size and 0 <= y < size for x, y in owners} == {True}


def test_as_many_faces_fit_as_it_says():
    size = 512
    count = faces_that_fit(size)
    assert count > XATLAS_FACES  # fewer are unwrapped to charts
    faces = np.resize(BALL.faces, (count, 3))
    uv = in_grid(BALL.vertices, faces, size).uv
    assert uv.max() <= 1
    legs = np.ptp(uv.reshape(count, 3, 2), axis=1) * size
    assert legs.min() >= 2


def test_many_faces_are_unwrapped_to_the_grid():
    many = trimesh.creation.icosphere(subdivisions=4)
    found = unwrap(many.vertices, many.faces, 512)
    assert len(found.rows) == 3 * len(many.faces)  # every face for itself
