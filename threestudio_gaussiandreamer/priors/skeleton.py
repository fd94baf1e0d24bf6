"""The skeleton of SMPL's bodies, whose joints this package uses for all bodies, and the axes of
bodies: y up, looking along +z, the left side at +x, as SMPL, HumanML3D and MakeHuman have them.
"""

import numpy as np
from jaxtyping import Float

from ..meshes.mesh import Mesh

JOINTS = (
    "pelvis, left hip, right hip, lower spine, left knee, right knee, middle spine, left "
    "ankle, right ankle, upper spine, left foot,"
    " right foot, neck, left collar, right collar, head, left shoulder, right shoulder, left "
    "elbow, right elbow, left wrist, right wrist,"
    " left hand, right hand"
).split(", ")
BODY_JOINTS = 22
"""The first joints of SMPL, SMPL-H and SMPL-X, and all of HumanML3D."""
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
"""Of the first ``BODY_JOINTS`` joints; every joint comes after its parent."""
LEFT, RIGHT = (1, 16), (2, 17)
"""Hip and shoulder of each side."""


def z_up(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Rotate points from y up, front +z, to z up, front +x."""
    return points[:, [2, 0, 1]]


def facing(joints: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about the world's z axis after which a body with these joints (y up)
    faces +x.

    The front is horizontal and perpendicular to the sum of the vectors from the left to the right
    hip and shoulder. If that sum is vertical or zero, the body isn't rotated."""
    joints = z_up(joints)
    across = (joints[list(RIGHT)] - joints[list(LEFT)]).sum(axis=0)
    forward = np.cross([0.0, 0.0, 1.0], across)[:2]
    length = np.linalg.norm(forward)
    if length < 1e-6:
        return np.eye(3)
    x, y = forward / length
    return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])


def world_mesh(mesh: Mesh, joints: Float[np.ndarray, "K 3"], scale: float) -> Mesh:
    """Return a body with z up that faces +x, its box centred, and ``scale`` as half the longest
    side.

    Args:
        mesh: y up, any unit.
        joints: the body's, in the mesh's axes.
    """
    vertices = z_up(mesh.vertices) @ facing(joints).T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return mesh._replace(vertices=scale * (vertices - (low + high) / 2) / ((high - low).max() / 2))
