"""Motions of a person for the toybox: joint positions of random style, their sentences, and the 263
features per frame that text-to-motion models of HumanML3D (Guo et al. 2022) are trained on.

y is up, the person looks along +z and has its left at +x; metres, :data:`RATE` frames a second. An
action sets the pelvis, the lean of the trunk, the directions of both arms, and the places of both
ankles; knees follow by inverse kinematics, so bones keep their lengths, standing feet their places.
"""

from collections.abc import Callable
from typing import NamedTuple, Optional

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..priors.body_pose import BODY_JOINTS, INDEX, PARENTS, SIDES

RATE, FRAMES = 20, 60
REST = np.zeros((BODY_JOINTS, 3))
"""Offset of each joint from its parent in a T-pose."""
for _joint, _offset in {
    "lower spine": (0, 0.11, -0.01), "middle spine": (0, 0.13, 0), "upper spine": (0, 0.06, 0),
    "neck": (0, 0.21, 0), "head": (0, 0.10, 0.03),
    "left hip": (0.08, -0.08, 0), "left knee": (0, -0.40, 0), "left ankle": (0, -0.41, 0),
    "left foot": (0, -0.06, 0.13), "left collar": (0.07, 0.12, 0), "left shoulder": (0.11, 0.02, 0),
    "left elbow": (0.26, 0, 0), "left wrist": (0.25, 0, 0),
}.items():  # fmt: skip
    REST[INDEX[_joint]] = _offset
    if _joint.startswith("left"):
        REST[INDEX[_joint.replace("left", "right")]] = np.array(_offset) * [-1, 1, 1]
THIGH, SHIN, ANKLE = 0.40, 0.41, 0.06
HEIGHT = 0.08 + THIGH + SHIN + ANKLE
"""Of a standing person's pelvis with straight legs; ANKLE is that of the ankles."""
SIGN = {"left": 1.0, "right": -1.0}


class Style(NamedTuple):
    """What an action draws from: a phase in [0, 1] per frame, and random numbers."""

    t: Float[np.ndarray, " T"]
    """Seconds."""
    rng: np.random.Generator

    def about(self, value: float, share: float = 0.12) -> float:
        """Draw a number within this share of ``value``."""
        return value * self.rng.uniform(1 - share, 1 + share)

    def rise(self, at: float, seconds: float) -> Float[np.ndarray, " T"]:
        """Return a smooth step from 0 to 1 that begins at time ``at``."""
        x = ((self.t - at) / seconds).clip(0, 1)
        return x * x * (3 - 2 * x)

    def wave(self, hertz: float, phase: float = 0.0) -> Float[np.ndarray, " T"]:
        """Return a sine."""
        return np.sin(2 * np.pi * (hertz * self.t + phase))


class Arm(NamedTuple):
    """Directions of the upper and the lower arm, in the chest's axes; degrees."""

    up: np.ndarray | float = 8.0
    """From hanging (0) over horizontal (90) to upwards (180)."""
    ahead: np.ndarray | float = 10.0
    """From sideways (0) to forwards (90)."""
    up2: np.ndarray | float = 14.0
    ahead2: np.ndarray | float = 40.0

    def towards(self, other: "Arm", share: np.ndarray) -> "Arm":
        """Move by a share of the way."""
        return Arm(*(a + (b - a) * share for a, b in zip(self, other, strict=True)))


class Body(NamedTuple):
    """The person in all frames."""

    pelvis: Float[np.ndarray, "T 3"]
    lean: Float[np.ndarray, "T 3"]
    """Rotation of the trunk about x (forwards), y and z, degrees."""
    arms: dict[str, Arm]
    ankles: dict[str, Float[np.ndarray, "T 3"]]
    toes: dict[str, np.ndarray]
    """Pitch of each foot, degrees, upwards."""

    def leaning(self, ahead: np.ndarray | float, turn: np.ndarray | float = 0.0) -> "Body":
        """Lean and turn the trunk further, degrees."""
        more = np.broadcast_arrays(ahead, turn, 0 * self.lean[:, 0])
        return self._replace(lean=self.lean + np.stack(more, 1))


def standing(s: Style, *, drop: float | np.ndarray = 0.02) -> Body:
    """Return a person that stands, breathes, and sways a little."""
    n, half = len(s.t), s.about(0.10, 0.25)
    sway = 0.008 * s.wave(s.about(0.4, 0.4), s.rng.uniform())
    pelvis = np.stack([sway, np.broadcast_to(HEIGHT - drop, n), 0 * s.t], 1)
    lean = np.stack([s.rng.uniform(-2, 4) + 0 * s.t, s.rng.uniform(-4, 4) + 0 * s.t, -20 * sway], 1)
    idle = {side: Arm(*(value + s.rng.uniform(-4, 8) for value in Arm())) for side in SIDES}
    turn = s.rng.uniform(-0.02, 0.02)
    places = {side: (SIGN[side] * half, ANKLE, SIGN[side] * turn) for side in SIDES}
    ankles = {side: np.tile(place, (n, 1)) for side, place in places.items()}
    return Body(pelvis, lean, idle, ankles, dict.fromkeys(SIDES, 0 * s.t))


def arms(s: Style, body: Body, to: Arm, share: np.ndarray, sides=SIDES) -> Body:
    """Move these arms by a share towards ``to``, each with a style of its own."""
    found = dict(body.arms)
    for side in sides:
        goal = Arm(*(value + s.rng.uniform(-5, 5) for value in to))
        found[side] = found[side].towards(goal, share)
    return body._replace(arms=found)


def open_arms(s: Style, side: str) -> Body:
    up = s.about(58, 0.1)
    return arms(s, standing(s), Arm(up, 15, up + 24, 34), s.rise(0, s.about(0.8)))


def t_pose(s: Style, side: str) -> Body:
    body = arms(s, standing(s), Arm(90, 0, 90, 0), 0 * s.t + 1)
    return body._replace(lean=np.zeros_like(body.lean))


def raise_arms(s: Style, side: str) -> Body:
    return arms(s, standing(s), Arm(s.about(160, 0.06), 20, 170, 20), s.rise(0, s.about(0.8)))


def wave(s: Style, side: str) -> Body:
    swing = s.about(28) * s.wave(s.about(1.6, 0.25), s.rng.uniform())
    goal = Arm(s.about(80), s.about(25, 0.4), 158 + swing, 0)
    return arms(s, standing(s), goal, s.rise(0, s.about(0.6)), (side,))


def point(s: Style, side: str) -> Body:
    up = s.about(88, 0.08)
    return arms(s, standing(s), Arm(up, 82, up, 86), s.rise(0, s.about(0.7)), (side,))


def punch(s: Style, side: str) -> Body:
    other = "right" if side == "left" else "left"
    guard, strike = Arm(32, 70, 135, 95), Arm(88, 92, 90, 96)
    out = s.wave(s.about(0.75, 0.15), s.rng.uniform()).clip(0, 1) ** 0.5
    body = arms(s, standing(s, drop=0.07), guard, s.rise(0, 0.3), (other,))
    body.arms[side] = guard.towards(strike, out)
    z = s.about(0.14)
    for leg in SIDES:  # one foot ahead
        body.ankles[leg][:, 2] += z if leg == other else -z
    return body.leaning(6.0, -SIGN[side] * s.about(24) * out)


def kick(s: Style, side: str) -> Body:
    body, start = standing(s, drop=0.03), s.rng.uniform(0.2, 0.7)
    out = s.rise(start, s.about(0.35)) * (1 - s.rise(start + s.about(1.0), s.about(0.6)))
    body.pelvis[:, 0] -= SIGN[side] * 0.08 * out  # over the other foot
    high, far = s.about(0.68, 0.15), s.about(0.76, 0.05)
    body.ankles[side][:, 1] += high * out
    body.ankles[side][:, 2] += far * np.sin(np.pi / 2 * out)
    body.toes[side] = 40 * out
    return arms(s, body, Arm(48, 15, 60, 40), out).leaning(-10 * out)


def gait(s: Style, hertz: float, speed: float, lift: float, flight: float) -> Body:
    """Walk or run ahead: each foot rests for half a period less ``flight``, then swings."""
    body, phase, rest = standing(s, drop=0.05 + 0.04 * (flight > 0)), s.rng.uniform(), 0.5 - flight
    for side, half in zip(SIDES, (0.0, 0.5), strict=True):
        cycle = hertz * s.t + phase + half
        swing = ((cycle % 1 - rest) / (1 - rest)).clip(0, 1)
        # of each stance, the place where the body passes over the foot in its middle
        stance = speed * (np.floor(cycle) + rest / 2 - phase - half) / hertz
        body.ankles[side][:, 2] = stance + speed / hertz * swing * swing * (3 - 2 * swing)
        body.ankles[side][:, 1] += lift * np.sin(np.pi * swing)
        body.ankles[side][:, 0] *= 0.7
        body.toes[side] = -35 * np.sin(np.pi * swing) * (swing < 0.6)
        forward = -np.cos(2 * np.pi * cycle)  # against the leg
        bend = 75 if flight else 18
        ahead = np.where(forward > 0, 88, -88)
        amount = s.about(46 if flight else 30) * np.abs(forward)
        body.arms[side] = Arm(6 + amount, ahead, amount + bend, 88 if flight else ahead)
    body.pelvis[:, 1] += (0.04 if flight else 0.015) * np.abs(np.sin(2 * np.pi * hertz * s.t))
    body.pelvis[:, 2] = speed * s.t
    return body.leaning(12 if flight else 2)


def walk(s: Style, side: str) -> Body:
    return gait(s, s.about(0.9), s.about(1.0, 0.2), s.about(0.12), 0.0)


def run(s: Style, side: str) -> Body:
    return gait(s, s.about(1.45), s.about(2.4), s.about(0.34), 0.14)


def sit(s: Style, side: str) -> Body:
    down = s.rise(0, s.about(0.9))
    body = standing(s, drop=0.02 + s.about(0.44, 0.05) * down)
    body.pelvis[:, 2] -= 0.42 * down
    return arms(s, body.leaning(25 * np.sin(np.pi * down) + 4), Arm(28, 80, 72, 92), down)


def squat(s: Style, side: str) -> Body:
    down = s.rise(0, s.about(0.9))
    body = standing(s, drop=0.02 + s.about(0.5, 0.1) * down)
    for leg in SIDES:
        body.ankles[leg][:, 0] *= 1.7
    body.pelvis[:, 2] -= 0.12 * down
    return arms(s, body.leaning(32 * down), Arm(78, 85, 84, 90), down)


def jump(s: Style, side: str) -> Body:
    period, high = s.about(1.15), s.about(0.34)
    part = (s.t / period + s.rng.uniform()) % 1
    air = np.sin(np.pi * ((part - 0.4) / 0.45).clip(0, 1))
    crouch = np.sin(np.pi * (part / 0.4).clip(0, 1)) ** 2
    body = standing(s, drop=0.03 + 0.2 * crouch)
    body.pelvis[:, 1] += high * air
    for leg in SIDES:
        body.ankles[leg][:, 1] += (high + 0.06) * air
        body.toes[leg] = -45 * air
    back, up = Arm(35, -80, 40, -60), Arm(s.about(140), 40, 150, 40)
    return arms(s, arms(s, body.leaning(22 * crouch), back, crouch), up, air)


def bow(s: Style, side: str) -> Body:
    down = s.rise(s.rng.uniform(0, 0.4), s.about(0.9))
    body = standing(s, drop=0.03)
    body.pelvis[:, 2] -= 0.16 * down
    return arms(s, body.leaning(s.about(72) * down), Arm(10, 60, 16, 80), down)


class Action(NamedTuple):
    """A kind of motion, and what follows its subject, where "{}" is left or right."""

    make: Callable[[Style, str], Body]
    phrases: tuple[str, ...]


ACTIONS: dict[str, Action] = {
    "open arms": Action(open_arms,
        ("stands with open arms", "opens the arms", "stands with the arms open")),
    "t pose": Action(t_pose, ("stands in a t pose", "is in a t pose", "holds a t pose")),
    "raise": Action(raise_arms, ("raises both arms", "lifts both arms", "raises the arms")),
    "wave": Action(wave, ("waves with the {} hand", "waves the {} hand", "waves the {} arm")),
    "point": Action(point, ("points with the {} hand", "points ahead with the {} arm")),
    "punch": Action(punch, ("punches with the {} hand", "punches with the {} fist")),
    "kick": Action(kick, ("kicks with the {} leg", "kicks the {} leg", "kicks with the {} foot")),
    "walk": Action(walk, ("walks", "walks forward", "walks ahead")),
    "run": Action(run, ("runs", "runs forward", "runs ahead")),
    "sit": Action(sit, ("sits", "sits down")),
    "squat": Action(squat, ("squats", "squats down", "crouches")),
    "jump": Action(jump, ("jumps", "jumps up", "jumps high")),
    "bow": Action(bow, ("bows", "bows down", "takes a bow")),
}  # fmt: skip


class Motion(NamedTuple):
    positions: Float[np.ndarray, "T 22 3"]
    best: int
    """The frame that shows the action: the last one of those that are held."""


def names() -> list[str]:
    """Return all actions with their sides: "kick left", "kick right", "walk", ..."""
    sides = {name: SIDES if "{}" in of.phrases[0] else ("",) for name, of in ACTIONS.items()}
    return [f"{name} {side}".rstrip() for name, both in sides.items() for side in both]


def draw(name: str, rng: np.random.Generator, frames: int = FRAMES) -> Motion:
    """Draw a motion of one of :func:`names`."""
    action, side = split(name)
    style = Style(np.arange(frames) / RATE, rng)
    positions = joint_positions(ACTIONS[action].make(style, side or "left"))
    best = len(positions) - 1
    if action in PEAKS:
        best = int(PEAKS[action](positions, int(side == "right")).argmax())
    return Motion(positions, best)


def split(name: str) -> tuple[str, Optional[str]]:
    """Split a name of :func:`names` into the action and the side."""
    first, _, last = name.rpartition(" ")
    return (first, last) if last in SIDES else (name, None)


PEAKS: dict[str, Callable[[np.ndarray, int], np.ndarray]] = {
    "kick": lambda p, i: p[:, INDEX["left ankle"] + i, 1],
    "punch": lambda p, i: p[:, INDEX["left wrist"] + i, 2],
    "jump": lambda p, i: p[:, 0, 1],
    "walk": lambda p, i: np.abs(p[:, INDEX["left ankle"], 2] - p[:, INDEX["right ankle"], 2]),
}
"""What is largest in the frame that shows an action best; the right side has ``i`` = 1."""
PEAKS["run"] = PEAKS["walk"]


# Kinematics -----------------------------------------------------------------------------------


def joint_positions(body: Body) -> Float[np.ndarray, "T 22 3"]:
    """Return the places of all joints."""
    frames = len(body.pelvis)
    found, turns = np.zeros((frames, BODY_JOINTS, 3)), {}
    found[:, 0] = body.pelvis
    bend = Rotation.from_euler("yxz", body.lean[:, [1, 0, 2]], degrees=True)
    for joint, parent in enumerate(PARENTS[1:16], 1):
        share = {0: 0.15, 3: 0.45, 6: 0.75}.get(parent, 1.0)
        turn = turns.setdefault(parent, Rotation.from_rotvec(share * bend.as_rotvec()))
        found[:, joint] = found[:, parent] + turn.apply(REST[joint])
    chest = turns[9]
    for side in SIDES:
        arm, sign = body.arms[side], SIGN[side]
        shoulder, elbow, wrist = (INDEX[f"{side} {n}"] for n in ("shoulder", "elbow", "wrist"))
        found[:, shoulder] = found[:, PARENTS[shoulder]] + chest.apply(REST[shoulder])
        for joint, up, ahead in ((elbow, arm.up, arm.ahead), (wrist, arm.up2, arm.ahead2)):
            up, ahead, _ = np.radians(np.broadcast_arrays(up, ahead, np.zeros(frames)))
            away = (sign * np.sin(up) * np.cos(ahead), -np.cos(up), np.sin(up) * np.sin(ahead))
            bone = np.abs(REST[joint, 0]) * chest.apply(np.stack(away, 1))
            found[:, joint] = found[:, PARENTS[joint]] + bone
        hip, knee, ankle, foot = (INDEX[f"{side} {n}"] for n in ("hip", "knee", "ankle", "foot"))
        found[:, knee], found[:, ankle] = two_bones(found[:, hip], body.ankles[side])
        pitch = np.radians(np.broadcast_to(body.toes[side], frames))
        y, z = REST[foot, 1:]
        turned = (y * np.cos(pitch) + z * np.sin(pitch), z * np.cos(pitch) - y * np.sin(pitch))
        found[:, foot] = found[:, ankle] + np.stack([0 * pitch, *turned], 1)
    return found


def two_bones(
    hip: Float[np.ndarray, "T 3"], ankle: Float[np.ndarray, "T 3"]
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Return knees that point ahead, and ankles: as near to the wanted ones as the legs reach."""
    away = ankle - hip
    wanted = np.linalg.norm(away, axis=1, keepdims=True)
    away, length = away / wanted, wanted.clip(0.15, (THIGH + SHIN) * 0.9995)
    along = (THIGH**2 - SHIN**2 + length**2) / (2 * length)
    ahead = np.array([0.0, 0.25, 1.0])
    ahead = ahead - away * (away @ ahead)[:, None]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    out = np.sqrt((THIGH**2 - along**2).clip(0))
    return hip + along * away + out * ahead, hip + length * away


# Features -------------------------------------------------------------------------------------


def features(positions: Float[np.ndarray, "T 22 3"]) -> Float[np.ndarray, "T-1 263"]:
    """Return HumanML3D's features of a motion that begins looking along +z.

    Half the angle by which the heading turns, the pelvis' velocity on the ground, and its height
    (1, 2, 1); the other joints relative to the pelvis' place on the ground (63); their rotations,
    two columns of a matrix each (126); velocities of all (66), all in the axes of the heading; and
    whether ankles and feet rest (4)."""
    p = positions - positions[:1, :1] * [1, 0, 1]
    across = p[:, [1, 16]].sum(1) - p[:, [2, 17]].sum(1)
    heading = np.unwrap(np.arctan2(-across[:, 2], across[:, 0]))
    turn = Rotation.from_rotvec(heading[:, None] * [0, 1, 0])
    back = turn.inv().as_matrix()
    local = np.einsum("tab,tjb->tja", back, p - p[:, :1] * [1, 0, 1])[:, 1:]
    steps = p[1:] - p[:-1]
    velocity = np.einsum("tab,tjb->tja", back[:-1], steps)
    ground = np.einsum("tab,tb->ta", back[1:], steps[:, 0])[:, [0, 2]]
    rests = (steps[:, [7, 10, 8, 11]] ** 2).sum(-1) < 0.002
    parts = (
        -np.diff(heading)[:, None] / 2, ground, p[:-1, 0, 1:2],
        local[:-1], rotations(p, turn)[:-1], velocity, rests,
    )  # fmt: skip
    return np.concatenate([part.reshape(len(steps), -1) for part in parts], 1).astype(np.float32)


LEGS, ARMS = ((0, 2, 5, 8, 11), (0, 1, 4, 7, 10)), ((9, 14, 17, 19, 21), (9, 13, 16, 18, 20))
CHAINS = *LEGS, (0, 3, 6, 9, 12, 15), *ARMS


def rotations(p: np.ndarray, heading) -> Float[np.ndarray, "T 21 6"]:
    """Return each joint's least rotation from its resting bone, relative to its chain's joint
    before; the first two columns of the matrices."""
    found = np.zeros((len(p), BODY_JOINTS, 6))
    for chain in CHAINS:
        turn = heading
        for joint, end in zip(chain, chain[1:], strict=False):
            bone = p[:, end] - p[:, joint]
            bone = turn.inv().apply(bone / np.linalg.norm(bone, axis=1, keepdims=True))
            rest = REST[end] / np.linalg.norm(REST[end])
            axis = np.cross(rest, bone)
            length = np.linalg.norm(axis, axis=1, keepdims=True)
            angle = np.arctan2(length, (bone @ rest)[:, None])
            own = Rotation.from_rotvec(axis / length.clip(1e-9) * angle)
            found[:, end] = own.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)
            turn = turn * own
    return found[:, 1:]
