"""Texture coordinates give no texel to two faces; textures hold the colours of the renders."""

import math

import numpy as np
import pytest
import torch
import trimesh

from threestudio_gaussiandreamer.cameras import Orbit
from threestudio_gaussiandreamer.meshes.mesh import Mesh, surface_colors
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster
from threestudio_gaussiandreamer.surface.bake import (
    SMALLEST_CELL,
    XATLAS_FACES,
    bake,
    faces_that_fit,
    filled,
    in_charts,
    in_grid,
    unwrap,
)
from threestudio_gaussiandreamer.surface.fusion import Renders

FOVY = math.radians(50)
BALL = trimesh.creation.icosphere(subdivisions=2)


def on_ball(atlas):
    return Mesh(BALL.vertices[atlas.rows], atlas.faces, uv=atlas.uv)


def front():
    orbit = Orbit(*(torch.tensor([value]) for value in (0.0, 0.0, 3.0, FOVY)))
    return orbit.c2w.double().numpy()


def cameras(count, turn=0.0):
    index = torch.arange(count)
    elevation = torch.rad2deg(torch.asin(torch.linspace(-0.9, 0.9, count)))
    angle = torch.full((count,), FOVY)
    orbit = Orbit(elevation, turn + 137.5 * index, torch.full((count,), 3.0), angle)
    return orbit.c2w.double().numpy()


@pytest.mark.parametrize("unwrapped", [in_charts, in_grid])
def test_renders_of_the_baked_mesh_are_those_it_was_baked_from(unwrapped):
    painted = Mesh(BALL.vertices, BALL.faces, vertex_colors=(0.5 + 0.4 * BALL.vertices))
    caster, size = MeshCaster(painted), 160
    images = caster.render_views([(c2w, FOVY) for c2w in cameras(16)], size, size, supersample=1)
    renders = Renders(cameras(16), np.round(255 * images).astype(np.uint8), FOVY)
    atlas = unwrapped(BALL.vertices, BALL.faces, 160)
    mesh = on_ball(atlas)
    baked = MeshCaster(mesh._replace(texture=bake(mesh, renders, 160)))
    unseen = [(c2w, FOVY) for c2w in cameras(5, turn=60)]
    ours, truth = (each.render_views(unseen, 96, 96) for each in (baked, caster))
    assert -10 * np.log10(np.square(ours - truth).mean()) > 40
    assert 0 <= atlas.uv.min() and atlas.uv.max() <= 1  # the corners of the faces are kept
    corners = np.sort(atlas.rows[atlas.faces], axis=1)
    np.testing.assert_array_equal(corners, np.sort(BALL.faces, axis=1))
    again = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert again.volume == pytest.approx(BALL.volume)  # and their orientation


def test_what_is_hidden_takes_the_colour_of_the_nearest_face():
    """A wall behind another one: only the one in front is seen, so only it gets its colour."""
    wall = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], float)
    vertices = np.concatenate([wall + [0.5, 0, 0], wall - [0.5, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [0.4, 0.9] + 0.05
    mesh = Mesh(vertices, faces, uv=np.concatenate([square, square + [0.5, 0]]))
    rgba = np.full((1, 64, 64, 4), [200, 40, 10, 255], np.uint8)
    texture = bake(mesh, Renders(front(), rgba, FOVY), 32)
    assert (texture[4:-4, 4:12] == [200, 40, 10]).all()
    _, face, _ = MeshCaster(mesh).visible(front()[0], FOVY, 64, 64)
    assert set(np.unique(face)) <= {-1, 0, 1}
    mesh = on_ball(in_grid(BALL.vertices, BALL.faces, 120))
    painted = mesh._replace(vertex_colors=np.where(mesh.vertices[:, :1] > 0, [1, 0, 0], [0, 0, 1]))
    images = MeshCaster(painted).render_views([(front()[0], FOVY)], 96, 96, supersample=1)
    renders = Renders(front(), np.round(255 * images).astype(np.uint8), FOVY)
    baked = mesh._replace(texture=bake(mesh, renders, 120))
    behind = np.flatnonzero(mesh.vertices[mesh.faces].mean(axis=1)[:, 0] < 0)
    colors = surface_colors(baked, behind, np.full((len(behind), 3), 1 / 3))
    assert (colors[:, 0] > 0.9).all() and (colors[:, 2] < 0.1).all()


def test_gaps_take_the_mean_of_their_surroundings_and_triangles_share_no_texel():
    colors, known = np.zeros((7, 9, 3)), np.zeros((7, 9), bool)
    colors[0, 0], colors[6, 8] = 10, 30
    known[0, 0] = known[6, 8] = True
    found = filled(colors, known)
    assert (found[0, 0] == 10).all() and (found[6, 8] == 30).all()
    assert (found[1, 1] == 10).all() and 10 <= found.min() and found.max() <= 30
    np.testing.assert_array_equal(filled(colors, np.zeros((7, 9), bool)), colors)
    size = 2 * SMALLEST_CELL * 7
    found = in_grid(BALL.vertices, BALL.faces[:90], size)
    owners = {}
    for face, corners in enumerate(found.uv[found.faces]):
        for texel in texels_of(corners, size):
            assert owners.setdefault(texel, face) == face
    assert {0 <= x < size and 0 <= y < size for x, y in owners} == {True}


def texels_of(corners, size):
    """Return the texels that bilinear lookup touches at many places of a triangle."""
    weights = np.random.default_rng(0).dirichlet([0.4] * 3, 400)
    places = np.concatenate([np.eye(3), weights]) @ corners * size - 0.5
    first = np.floor(places + 1e-9).astype(int)
    right, down = np.ceil(places - 1e-9).astype(int).T
    columns, rows = first.T
    pairs = [(x, y) for x in (columns, right) for y in (rows, down)]
    return {texel for x, y in pairs for texel in zip(x, y, strict=True)}


def test_as_many_faces_fit_as_it_says_and_go_to_the_grid(size=512):
    count = faces_that_fit(size)
    assert count > XATLAS_FACES  # fewer are unwrapped to charts
    found = unwrap(BALL.vertices, np.resize(BALL.faces, (count, 3)), size)
    assert len(found.rows) == 3 * count and found.uv.max() <= 1  # every face for itself
    assert np.ptp(found.uv.reshape(count, 3, 2), axis=1).min() * size >= 2
