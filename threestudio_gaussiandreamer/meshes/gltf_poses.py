"""Where a glTF scene places its nodes, and vertices that follow the joints of a skin."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.quaternions import rotation_rows
from .gltf_document import Document

World = Float[np.ndarray, "4 4"]


def world_matrices(document: Document) -> dict[int, World]:
    """Return the matrix from each node of the default scene to the world, parents first.

    Without scenes, the nodes that are no children are the roots.

    Raises:
        UserError: a node is shown twice, which would be a cycle or no tree.
    """
    worlds: dict[int, World] = {}
    waiting = [(root, np.eye(4)) for root in reversed(_roots(document))]
    while waiting:
        index, above = waiting.pop()
        node = document.entry("nodes", index)
        if index in worlds:
            document.fail(f"node {index} has two parents")
        worlds[index] = above @ local_matrix(document, node)
        waiting += [(child, worlds[index]) for child in reversed(node.get("children", []))]
    return worlds


def _roots(document: Document) -> list[Any]:
    if document.json.get("scenes"):
        return document.entry("scenes", document.json.get("scene", 0)).get("nodes", [])
    nodes = document.json.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def local_matrix(document: Document, node: dict[str, Any]) -> World:
    """Return a node's matrix to its parent: its own, or T R S."""
    if "matrix" in node:
        return document.numbers(node["matrix"], 16, "the matrix of a node").reshape(4, 4).T
    matrix = np.eye(4)
    rotation = document.numbers(node.get("rotation", [0, 0, 0, 1]), 4, "the rotation of a node")
    scale = document.numbers(node.get("scale", [1, 1, 1]), 3, "the scale of a node")
    matrix[:3, :3] = rotation_matrix(rotation) * scale
    matrix[:3, 3] = document.numbers(node.get("translation", [0] * 3), 3, "the place of a node")
    return matrix


def rotation_matrix(xyzw: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of a quaternion; zero is the identity."""
    if not xyzw.any():
        return np.eye(3)
    x, y, z, w = xyzw / np.linalg.norm(xyzw)
    return np.array(rotation_rows(w, x, y, z))


def skinned(
    document: Document,
    skin: Any,
    attributes: dict[str, Any],
    positions: Float[np.ndarray, "V 3"],
    worlds: dict[int, World],
) -> Float[np.ndarray, "V 3"]:
    """Return the vertices of a skinned mesh in the pose of its joints.

    The mesh's own node doesn't move it (glTF 2.0, 3.7.3.3); each vertex is moved by the weighted
    mean of its joints' matrices.
    """
    matrices = _joint_matrices(document, document.entry("skins", skin), worlds)
    blended, total = np.zeros((len(positions), 4, 4)), np.zeros(len(positions))
    document.budget.spend(blended.nbytes, "a skinned mesh")
    for joints, weights in _influences(document, attributes, len(positions)):
        if joints.size and joints.max() >= len(matrices):
            document.fail(f"a vertex follows joint {joints.max()} of {len(matrices)}")
        for column in range(4):
            blended += weights[:, column, None, None] * matrices[joints[:, column]]
            total += weights[:, column]
    blended /= np.where(total > 0, total, 1)[:, None, None]
    return np.einsum("vij,vj->vi", blended[:, :3, :3], positions) + blended[:, :3, 3]


def _joint_matrices(
    document: Document, skin: dict[str, Any], worlds: dict[int, World]
) -> Float[np.ndarray, "J 4 4"]:
    joints = skin["joints"]
    if any(joint not in worlds for joint in joints):
        document.fail("a joint of a skin isn't in the scene")
    matrices = np.stack([worlds[joint] for joint in joints])
    if "inverseBindMatrices" not in skin:
        return matrices
    inverse = document.accessor(skin["inverseBindMatrices"], ("MAT4",)).floats()
    if len(inverse) < len(joints):
        document.fail(f"a skin has {len(inverse)} matrices for {len(joints)} joints")
    return matrices @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)


def _influences(document: Document, attributes: dict[str, Any], count: int):
    """Yield the joints (V, 4) and their weights (V, 4) of each set of attributes."""
    sets = sum(name.startswith("JOINTS_") for name in attributes)
    for number in range(sets):
        joints = document.accessor(attributes[f"JOINTS_{number}"], ("VEC4",)).values
        weights = document.accessor(attributes[f"WEIGHTS_{number}"], ("VEC4",))
        if joints.dtype.kind != "u" or not len(joints) == len(weights.values) == count:
            document.fail("the joints of a skinned mesh don't fit its vertices")
        yield joints, weights.floats(normalize=True)
