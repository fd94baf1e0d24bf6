"""Drop small parts of closed triangle meshes, simplify them, and keep them closed.

A mesh is closed if each edge has exactly two faces. Half-edge ``h`` of F faces is the directed edge
of face ``h % F`` from its corner ``h // F`` to the next one."""

import math

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import UserError

Vertices, Faces = Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]  # functions change how many
Pairs = tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]
"""Half-edges that run from the lower vertex index to the higher, and their partners."""
AGGRESSIVENESS = (7, 5, 3, 1)
"""Values of fast_simplification's ``agg``, in their order; lower ones keep more of the shape."""
ATTEMPTS = 4
APART = 0.05
"""Fraction of the way to their neighbours by which vertices at one position are moved apart."""


def without_small_parts(
    vertices: Vertices, faces: Faces, share: float
) -> tuple[Vertices, Faces, int]:
    """Drop connected parts with less than ``share`` of the area, and surfaces of inner cavities;
    also return the number of dropped parts that aren't cavities.
    """
    label = _labels(half_edges(faces), len(vertices))[faces[:, 0]]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    area = np.bincount(label, np.linalg.norm(normals, axis=1))
    volume = np.bincount(label, np.einsum("fk,fk->f", a, normals))
    keep = (area >= share * area.sum()) & (volume > 0)
    rows, index = np.unique(faces[keep[label]], return_inverse=True)
    return vertices[rows], index.reshape(-1, 3), int((~keep & (volume > 0)).sum())


def simplified(vertices: Vertices, faces: Faces, count: int) -> tuple[Vertices, Faces]:
    """Reduce a closed mesh to at most ``count`` faces by quadric errors; it stays closed.

    Raises:
        UserError: the shape can't be closed with so few faces.
    """
    for aggressiveness in AGGRESSIVENESS:
        target = count
        for _ in range(ATTEMPTS):
            found = _closed_again(*_fewer(vertices, faces, target, aggressiveness))
            if found is None or len(found[1]) <= count:
                break
            target -= len(found[1]) - count  # splitting edges has added faces
            if target < 4:  # of a tetrahedron, the smallest closed mesh
                break
        if found is not None and 0 < len(found[1]) <= count:
            return found
    said = f"faces: the surface can't be closed with {count} faces"
    raise UserError(f"{said}; allow more, or extract it with a lower resolution")


def _fewer(vertices: Vertices, faces: Faces, count: int, agg: int) -> tuple[Vertices, Faces]:
    import fast_simplification

    if len(faces) <= count:
        return vertices, faces
    # its thresholds are for meshes of about this size; a power of two leaves all digits
    extent = float(np.ptp(vertices, axis=0).max())
    scale = 2.0 ** -round(math.log2(extent / 2)) if extent > 0 else 1.0
    scaled = (vertices * scale).astype(np.float32)
    found, faces = fast_simplification.simplify(
        scaled, faces.astype(np.int32), target_count=count, agg=agg
    )
    return found / scale, faces


def _closed_again(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces] | None:
    """Separate surfaces that simplification made touch; None if the mesh can't be closed."""
    positions, index = joined(vertices, faces)
    kept = without_folds(index)
    found = separated(positions, kept) if len(kept) else None
    return found if found is not None and is_closed(joined(*found)[1]) else None


def joined(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Join vertices whose positions are equal in float32, the precision of mesh files."""
    positions, rows = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)
    return positions.astype(np.float64), rows.reshape(-1)[faces]


def without_folds(faces: Faces) -> Faces:
    """Drop faces with a repeated corner, repeated faces, and pairs of opposite faces."""
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    ordered = np.sort(faces, axis=1)
    lowest = faces.argmin(axis=1)
    following = faces[np.arange(len(faces)), (lowest + 1) % 3]
    turn = np.where(following == ordered[:, 1], 1, -1)
    _, index = np.unique(ordered, axis=0, return_inverse=True)
    index = index.reshape(-1)
    surplus = np.bincount(index, turn, minlength=1)[index]
    kept = faces[surplus * turn > 0]
    first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)[1]
    return kept[np.sort(first)]


def is_closed(faces: Faces) -> bool:
    """Return whether each edge has exactly two faces, which run along it in opposite directions."""
    edges = half_edges(faces)
    there, back = np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0)
    return len(there) == len(edges) and np.array_equal(there, back)


def half_edges(faces: Faces) -> Int[np.ndarray, "E 2"]:
    """Return the start and end of each half-edge: corners 0 to 1 of all faces, 1 to 2, 2 to 0."""
    return np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])


def separated(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces] | None:
    """Split the edges and vertices at which a closed mesh touches itself; None if it has holes.

    Around an edge of more than two faces, two faces make a pair if only inside lies between them.
    Each pair gets vertices of its own, which are moved by ``APART`` towards the mean of their
    neighbours. Where that leaves two pairs with the same two vertices, one of them gets a new
    vertex in the middle of the edge.
    """
    for _ in range(ATTEMPTS):
        pairs = _paired(vertices, faces)
        if pairs is None:
            return None
        old, faces = _split(faces, pairs)
        vertices, edges = vertices[old], half_edges(faces)
        degree = np.maximum(np.bincount(edges[:, 0], minlength=len(vertices)), 1)
        sums = [np.bincount(edges[:, 0], x[edges[:, 1]], len(vertices)) for x in vertices.T]
        toward = np.stack(sums, axis=1) / degree[:, None] - vertices
        vertices = vertices + APART * (np.bincount(old)[old] > 1)[:, None] * toward
        if is_closed(faces):
            return vertices, faces
        vertices, faces = _with_middles(vertices, faces, pairs)
    return None


def _split(faces: Faces, pairs: Pairs) -> tuple[Int[np.ndarray, " U"], Faces]:
    """Give each fan, the faces around a vertex that pairs connect, a vertex of its own; return the
    old vertex of each new one, and the faces of new vertices.
    """
    places = [np.divmod(edges, len(faces)) for edges in pairs]  # corner and face of half-edges
    (start, end), (other_start, other_end) = (
        (3 * face + corner, 3 * face + (corner + 1) % 3) for corner, face in places
    )
    links = [np.stack([start, other_end], axis=1), np.stack([end, other_start], axis=1)]
    label = _labels(np.concatenate(links), faces.size)
    old = np.zeros(label.max() + 1, np.int64)
    old[label] = faces.ravel()
    return old, label.reshape(-1, 3)


def _with_middles(vertices: Vertices, faces: Faces, pairs: Pairs) -> tuple[Vertices, Faces]:
    """Where an edge has several pairs of faces, split all pairs but the first at a new vertex near
    the middle of the edge. A pair with a face that is split already waits for the next attempt.
    """
    edges, count = half_edges(faces), len(faces)
    key = np.sort(edges[pairs[0]], axis=1)
    _, first = np.unique(key, axis=0, return_index=True)
    changed, added, places = set(), [], []
    for pair in np.setdiff1d(np.arange(len(key)), first):
        halves = [int(side[pair]) for side in pairs]
        if changed & {half % count for half in halves}:
            continue
        changed |= {half % count for half in halves}
        corners = [np.roll(faces[half % count], -(half // count)) for half in halves]
        opposite = vertices[[corner[2] for corner in corners]].mean(axis=0)
        middle = vertices[corners[0][:2]].mean(axis=0)
        places.append(middle + APART * (opposite - middle))
        new = len(vertices) + len(places) - 1
        added += [[row for a, b, c in corners for row in ([a, new, c], [new, b, c])]]
    kept = np.delete(faces, sorted(changed), axis=0)
    return np.concatenate([vertices, places]), np.concatenate([kept, *added])


def _paired(vertices: Vertices, faces: Faces) -> Pairs | None:
    """Pair each half-edge with one in the opposite direction; None if some have no partner."""
    edges = half_edges(faces)
    ahead = edges[:, 0] < edges[:, 1]
    key = edges.min(axis=1) * len(vertices) + edges.max(axis=1)
    angle = _angles(vertices, faces, edges, np.unique(key, return_inverse=True)[1])
    # the inside lies from the face of an ascending half-edge down to the next face around the edge
    first, second = (np.flatnonzero(side) for side in (ahead, ~ahead))
    first, second = (side[np.lexsort((angle[side], key[side]))] for side in (first, second))
    if len(first) != len(second) or (key[first] != key[second]).any():
        return None
    # rotated within each edge to the next face below that of ``first`` by angle
    _, start, count = np.unique(key[first], return_index=True, return_counts=True)
    for begin, size in zip(start[count > 1], count[count > 1], strict=True):
        rows = slice(begin, begin + size)
        below = np.searchsorted(angle[second[rows]], angle[first[begin]]) - 1
        second[rows] = np.roll(second[rows], -below)
    return first, second


def _angles(
    vertices: Vertices, faces: Faces, edges: Int[np.ndarray, "E 2"], group: Int[np.ndarray, " E"]
) -> Float[np.ndarray, " E"]:
    """Return the angle of each half-edge's face around its edge, radians, counterclockwise about
    the axis from the lower vertex index to the higher; 0 at edges (``group``) of up to two faces.
    """
    angles = np.zeros(len(edges))
    crowded = np.flatnonzero(np.bincount(group)[group] > 2)
    if not len(crowded):
        return angles
    low, high = vertices[edges[crowded].min(axis=1)], vertices[edges[crowded].max(axis=1)]
    axis = unit(high - low)
    other = faces[crowded % len(faces), (crowded // len(faces) + 2) % 3]
    across = vertices[other] - low
    side = unit(np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)]))
    up = np.cross(axis, side)
    angles[crowded] = np.arctan2((across * up).sum(1), (across * side).sum(1))
    return angles


def _labels(links: Int[np.ndarray, "L 2"], count: int) -> Int[np.ndarray, " N"]:
    """Return the connected component of each of ``count`` nodes."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(links), bool), links.T), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
