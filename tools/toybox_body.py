"""Make the toybox's body in SMPL's file format: ``python -m tools.toybox_body OUT.npz``.

A surface around the skeleton of :mod:`..toybox.motions`: tapered limbs that are joined smoothly, by
marching cubes; weights by the distance to each bone; ten shape directions, of which the last four
are small and random. All of it is generated: Apache-2.0, nothing of SMPL's data is in it.
"""

import argparse
from pathlib import Path

import numpy as np
from skimage.measure import marching_cubes

from threestudio_gaussiandreamer.priors.body_pose import JOINTS, PARENTS
from threestudio_gaussiandreamer.toybox.motions import REST

PARENTS24 = (*PARENTS, 20, 21)
CELL, SMOOTH = 0.03, 0.022
"""Size of a cell, and of the fillets between limbs, metres."""
BLEND = 0.035
"""Metres over which weights fall by 1/e."""
RADII = {
    "pelvis": (0.105, 0.11), "spine": (0.11, 0.12), "neck": (0.05, 0.05), "head": (0.09, 0.085),
    "hip": (0.085, 0.085), "knee": (0.078, 0.055), "ankle": (0.052, 0.038), "foot": (0.042, 0.034),
    "collar": (0.1, 0.075), "shoulder": (0.07, 0.055), "elbow": (0.048, 0.04),
    "wrist": (0.04, 0.032), "hand": (0.038, 0.03),
}  # fmt: skip
"""Radii at the beginning and at the end of the bone that ends at a joint."""
REGRESSED = 16
"""Vertices from which a joint is computed."""


def skeleton() -> np.ndarray:
    """Return the 24 joints at rest, pelvis at the origin."""
    rest = np.concatenate([REST, [[0.09, 0, 0], [-0.09, 0, 0]]])
    joints = np.zeros((24, 3))
    for joint, parent in enumerate(PARENTS24):
        joints[joint] = rest[joint] + (joints[parent] if parent >= 0 else 0)
    return joints


def bones(joints: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray, float, float]]:
    """Return (the joint that moves it, start, end, both radii) of each bone."""
    found = []
    for joint, parent in enumerate(PARENTS24):
        kind = JOINTS[joint].split()[-1]
        if parent >= 0:
            found.append((parent, joints[parent], joints[joint], *RADII[kind]))
    head = joints[15]
    found.append((15, head + [0, 0.03, -0.02], head + [0, 0.12, -0.005], *RADII["head"]))
    found += [(j, joints[j], joints[j] + [0, 0, 0.05], 0.035, 0.028) for j in (10, 11)]
    return found


def segment_distance(points: np.ndarray, start, end) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance to a segment, and the nearest place on it in [0, 1]."""
    along = end - start
    share = ((points - start) @ along / max(along @ along, 1e-12)).clip(0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1), share


def surface(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of the zero level of the smooth minimum of all limbs."""
    low, high = joints.min(0) - 0.2, joints.max(0) + 0.25
    axes = [np.arange(a, b, CELL) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    points, total = grid.reshape(-1, 3), 0.0
    for _, start, end, first, last in bones(joints):
        distance, share = segment_distance(points, start, end)
        total = total + np.exp(-(distance - first - (last - first) * share) / SMOOTH)
    field = -SMOOTH * np.log(np.maximum(total, 1e-300)).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="ascent")
    vertices = low + vertices * CELL
    left = vertices[:, 0] > 0
    assert abs(left.mean() - 0.5) < 0.05
    return vertices, faces


def weights(vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return skinning weights: rows sum to 1, at most four bones each."""
    found = np.zeros((len(vertices), 24))
    for joint, start, end, *_ in bones(joints):
        distance, _ = segment_distance(vertices, start, end)
        found[:, joint] = np.maximum(found[:, joint], np.exp(-((distance / BLEND) ** 1.5)))
    found += 1e-12
    smallest = np.sort(found, axis=1)[:, -4][:, None]
    found[found < smallest] = 0
    return found / found.sum(1, keepdims=True)


def regressor(vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return weights of nearby vertices, of least norm, which sum to 1 and give the joints."""
    found = np.zeros((24, len(vertices)))
    for joint, place in enumerate(joints):
        near = np.argsort(np.linalg.norm(vertices - place, axis=1))[:REGRESSED]
        rows = np.concatenate([vertices[near].T, np.ones((1, REGRESSED))])
        found[joint, near] = np.linalg.lstsq(rows, np.array([*place, 1.0]), rcond=None)[0]
    return found


def shape_directions(vertices: np.ndarray, joints: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """Return (V, 3, 10): size, girth, shoulders, hips, legs, arms, and four of smooth noise."""
    pivots = skin @ joints
    away = vertices - pivots
    arms = [
        j for j in range(24) if any(n in JOINTS[j] for n in ("shoulder", "elbow", "wrist", "hand"))
    ]
    legs = [j for j in range(24) if any(n in JOINTS[j] for n in ("hip", "knee", "ankle", "foot"))]
    arm, leg = skin[:, arms].sum(1), skin[:, legs].sum(1)
    side = np.sign(vertices[:, 0])
    flat = np.zeros_like(vertices)
    wide, hips = flat.copy(), flat.copy()
    wide[:, 0], hips[:, 0] = 0.02 * side * arm, 0.015 * side * leg
    long, reach = flat.copy(), flat.copy()
    long[:, 1] = 0.04 * leg * vertices[:, 1].clip(-1, 0)
    reach[:, 0] = 0.05 * arm * (vertices[:, 0] - 0.18 * side)
    rng = np.random.default_rng(0)
    noise = []
    for _ in range(4):
        waves = rng.normal(size=(3, 3)) * 4
        noise.append(0.003 * np.sin(vertices @ waves + rng.uniform(0, 6.28, 3)))
    return np.stack([0.04 * vertices, 0.06 * away, wide, hips, long, reach, *noise], -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    out, joints = parser.parse_args().out, skeleton()
    vertices, faces = surface(joints)
    skin = weights(vertices, joints)
    parents = np.array([[*PARENTS24], [*range(24)]], np.int64)
    parents[0, 0] = 2**32 - 1  # as SMPL's files have it
    np.savez_compressed(
        out,
        v_template=vertices.astype(np.float32),
        shapedirs=shape_directions(vertices, joints, skin).astype(np.float32),
        posedirs=np.zeros((len(vertices), 3, 207), np.float32),
        J_regressor=regressor(vertices, joints).astype(np.float32),
        weights=skin.astype(np.float32),
        kintree_table=parents,
        f=faces.astype(np.uint32),
    )
    print(f"{out}: {len(vertices)} vertices, {len(faces)} faces, {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
