"""Make the toybox's body in SMPL's file format: ``python -m tools.toybox_body OUT.npz``.

A surface around the skeleton of ``toybox/motions.py``, legs a little apart: tapered limbs that are
joined smoothly, by marching cubes; weights by the distance to each limb; ten shape directions, of
which the last four are small and random. All of it is generated: Apache-2.0, nothing of SMPL's data
is in it.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from skimage.measure import marching_cubes

from threestudio_gaussiandreamer.priors.body_pose import INDEX, JOINTS, PARENTS
from threestudio_gaussiandreamer.toybox.motions import REST

PARENTS24 = (*PARENTS, 20, 21)
CELL, SMOOTH = 0.026, 0.012
"""Size of a cell, and of the fillets between limbs, metres."""
LEGS_APART = 7.0
"""Degrees by which each leg points outwards."""
BLEND, SIDES_BLEND = 0.03, 0.03
"""Metres over which a limb's weights fall off its surface, and over which left becomes right."""
RADII = {
    "pelvis": (0.1, 0.1), "spine": (0.105, 0.11), "neck": (0.085, 0.05), "head": (0.055, 0.055),
    "hip": (0.1, 0.09), "knee": (0.086, 0.058), "ankle": (0.057, 0.04), "foot": (0.042, 0.034),
    "collar": (0.09, 0.072), "shoulder": (0.07, 0.056), "elbow": (0.05, 0.04),
    "wrist": (0.042, 0.03), "hand": (0.034, 0.03),
}  # fmt: skip
"""Radii at the beginning and at the end of the limb that ends at a joint."""
WIDE = {"pelvis": 1.15, "spine": 1.25}
"""How much wider than deep the trunk is."""
REGRESSED = 24
"""Vertices from which a joint is computed."""


class Limb(NamedTuple):
    """A tapered capsule."""

    joint: int
    """The one that moves it."""
    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    radii: tuple[float, float]
    wide: float = 1.0

    def distance(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Return the distance to the surface, less than zero inside."""
        scale = np.array([1 / self.wide, 1.0, 1.0])
        points, along = (points - self.start) * scale, (self.end - self.start) * scale
        share = (points @ along / max(along @ along, 1e-12)).clip(0, 1)
        away = np.linalg.norm(points - share[:, None] * along, axis=1)
        return away - self.radii[0] - (self.radii[1] - self.radii[0]) * share


def skeleton() -> Float[np.ndarray, "24 3"]:
    """Return the joints at rest, pelvis at the origin."""
    offsets = np.concatenate([REST, [[0.09, 0, 0], [-0.09, 0, 0]]])
    joints = np.zeros((24, 3))
    for joint, parent in list(enumerate(PARENTS24))[1:]:
        x, y, z = offsets[joint]
        if JOINTS[joint].endswith(("knee", "ankle")):
            angle = np.radians(LEGS_APART) * (1 if "left" in JOINTS[joint] else -1)
            x, y = -np.sin(angle) * y, np.cos(angle) * y
        joints[joint] = joints[parent] + [x, y, z]
    return joints


def limbs(joints: Float[np.ndarray, "24 3"]) -> Iterator[Limb]:
    """Return a limb for each bone, the skull, toes and heels."""
    for joint, parent in list(enumerate(PARENTS24))[1:]:
        kind = JOINTS[joint].split()[-1]
        yield Limb(parent, joints[parent], joints[joint], RADII[kind], WIDE.get(kind, 1.0))
    head = joints[INDEX["head"]]
    yield Limb(INDEX["head"], head + [0, 0.05, -0.03], head + [0, 0.12, -0.02], (0.08, 0.088))
    for ankle, foot in ((7, 10), (8, 11)):
        yield Limb(foot, joints[foot], joints[foot] + [0, 0, 0.05], (0.036, 0.03))
        yield Limb(ankle, joints[ankle], joints[ankle] + [0, -0.045, -0.04], (0.035, 0.03))


def surface(joints: Float[np.ndarray, "24 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of the zero level of the smooth minimum of all limbs."""
    low, high = joints.min(0) - 0.2, joints.max(0) + 0.25
    high[0] = -low[0] + 1e-9
    axes = [np.arange(a, b, CELL) for a, b in zip(low, high, strict=True)]
    axes[0] -= axes[0].mean()
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    points = grid.reshape(-1, 3)
    total = sum(np.exp(-limb.distance(points) / SMOOTH) for limb in limbs(joints))
    field = -SMOOTH * np.log(total.clip(1e-300)).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="descent")
    return grid[0, 0, 0] + vertices * CELL, faces


def skinning(vertices: np.ndarray, joints: np.ndarray) -> Float[np.ndarray, "V 24"]:
    """Return weights: rows sum to 1, above 1e-10 of at most four joints, of one side but amid."""
    found = np.full((len(vertices), 24), 1e-12)
    for limb in limbs(joints):
        own = np.exp(-((limb.distance(vertices).clip(0) / BLEND) ** 1.5))
        name = JOINTS[limb.joint]
        if "left" in name or "right" in name:
            x = vertices[:, 0] * (1 if "left" in name else -1)
            own *= (0.5 + x / SIDES_BLEND).clip(0, 1)
        found[:, limb.joint] = np.maximum(found[:, limb.joint], own)
    found[found < np.sort(found, axis=1)[:, -4:-3]] = 0
    return found / found.sum(1, keepdims=True)


def regressor(vertices: np.ndarray, joints: np.ndarray) -> Float[np.ndarray, "24 V"]:
    """Return weights of nearby vertices, of least norm, which sum to 1 and give the joints."""
    found = np.zeros((24, len(vertices)))
    for joint, place in enumerate(joints):
        near = np.argsort(np.linalg.norm(vertices - place, axis=1))[:REGRESSED]
        rows = np.concatenate([vertices[near].T, np.ones((1, REGRESSED))])
        found[joint, near] = np.linalg.lstsq(rows, np.array([*place, 1.0]), rcond=None)[0]
    return found


def shape_directions(
    vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray
) -> Float[np.ndarray, "V 3 10"]:
    """Return size, girth, width of shoulders and hips, lengths of legs and arms, and noise."""

    def share(*parts: str) -> np.ndarray:
        return weights[:, [j for j, name in enumerate(JOINTS) if name.endswith(parts)]].sum(1)

    arm, leg = share("shoulder", "elbow", "wrist", "hand"), share("hip", "knee", "ankle", "foot")
    x, y, _ = vertices.T
    side, none = np.sign(x), 0 * x
    columns = [
        0.04 * vertices,
        0.06 * (vertices - weights @ joints),
        np.stack([0.02 * side * arm, none, none], 1),
        np.stack([0.015 * side * leg, none, none], 1),
        np.stack([none, 0.04 * leg * y.clip(-1, 0), none], 1),
        np.stack([0.05 * arm * (x - 0.18 * side), none, none], 1),
    ]
    rng = np.random.default_rng(0)
    for _ in range(4):
        waves = rng.normal(size=(3, 3)) * 4
        columns.append(0.003 * np.sin(vertices @ waves + rng.uniform(0, 6.28, 3)))
    return np.stack(columns, -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    out, joints = parser.parse_args().out, skeleton()
    vertices, faces = surface(joints)
    weights = skinning(vertices, joints)
    parents = np.array([[*PARENTS24], [*range(24)]], np.int64)
    parents[0, 0] = 2**32 - 1  # as SMPL's files have it
    np.savez_compressed(
        out,
        v_template=vertices.astype(np.float32),
        shapedirs=shape_directions(vertices, joints, weights).astype(np.float32),
        posedirs=np.zeros((len(vertices), 3, 207), np.float16),
        J_regressor=regressor(vertices, joints).astype(np.float32),
        weights=weights.astype(np.float32),
        kintree_table=parents,
        f=faces.astype(np.uint32),
    )
    print(f"{out}: {len(vertices)} vertices, {len(faces)} faces, {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
