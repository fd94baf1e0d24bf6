"""The text-to-motion model alone: what its samples show, how steady its bones and feet are.

    python -m benchmarks.models.motions                       # the bundled model
    python -m benchmarks.models.motions --models FOLDER       # an export

Each action is sampled with several seeds, each with another wording. An action, with its side, is
recognised by the nearest of the generator's motions, in coordinates of the joints over time that
don't depend on where the person stands and looks; the share of fresh motions of the generator that
are recognised is printed first. A foot rests while it is within 2 cm of its lowest height; how far
it slides is its way on the ground from there to the next frame. Diversity is the mean distance of
joints between seeds. The generator's own numbers stand beside the model's.
"""

import argparse
import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from benchmarks.markdown import markdown
from threestudio_gaussiandreamer.models.bundled import MOTION, NAME, model_part
from threestudio_gaussiandreamer.models.clip import clip_source, text_features
from threestudio_gaussiandreamer.priors.body_pose import PARENTS
from threestudio_gaussiandreamer.priors.text_to_motion import (
    FRAMES,
    load_motion_model,
    sample_motions,
)
from threestudio_gaussiandreamer.toybox import motions

FITTED, FRESH, NEIGHBOURS = 40, 20, 5
"""Motions of each action that classify and that validate, and the nearest ones that vote."""
NEAR_GROUND = 0.02
Drawn = dict[str, Float[np.ndarray, "S T 22 3"]]


def generated(count: int, seed: int) -> Drawn:
    """Return ``count`` motions of the generator for each action."""
    rng = np.random.default_rng(seed)
    return {
        name: np.stack([motions.draw(name, rng, FRAMES).positions for _ in range(count)])
        for name in motions.names()
    }


def sampled(models: str, count: int) -> Drawn:
    """Return ``count`` samples of the model for each action."""
    model, clip, found = load_motion_model(model_part(models, MOTION)), clip_source(models), {}
    for name in motions.names():
        action, side = motions.split(name)
        wordings = itertools.cycle(motions.ACTIONS[action].phrases)
        texts = [f"Someone {next(wordings).format(side)}" for _ in range(count)]
        features = torch.cat([text_features(clip, text) for text in texts])
        rng = torch.Generator().manual_seed(0)
        found[name] = sample_motions(model, features, count, rng)
    return found


def placed(motion: Float[np.ndarray, "T 22 3"]) -> Float[np.ndarray, "T 22 3"]:
    """Return a motion that starts above the origin and looks along +z in the mean of its frames."""
    x, _, z = (motion[:, [1, 16]] - motion[:, [2, 17]]).sum((0, 1))
    c, s = np.array([x, z]) / np.hypot(x, z)
    return (motion - motion[0, 0] * [1, 0, 1]) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def looks(motion: Float[np.ndarray, "T 22 3"]) -> Float[np.ndarray, " D"]:
    """Return numbers that tell actions apart: of all coordinates relative to the pelvis mean,
    deviation and extremes over time, and the pelvis' heights and way.
    """
    motion = placed(motion)
    local = (motion - motion[:, :1] * [1, 0, 1]).reshape(len(motion), -1)
    way = 3 * np.linalg.norm(motion[-1, 0, [0, 2]])
    return np.concatenate([*(f(local, axis=0) for f in (np.mean, np.std, np.min, np.max)), [way]])


def recognised(fitted: Drawn, drawn: Drawn) -> dict[str, list[str]]:
    """Return the action of each motion by the vote of the nearest fitted ones."""
    names = np.repeat([*fitted], [len(group) for group in fitted.values()])
    tree = cKDTree([looks(motion) for group in fitted.values() for motion in group])
    found = {}
    for name, group in drawn.items():
        _, nearest = tree.query([looks(motion) for motion in group], NEIGHBOURS)
        found[name] = [Counter(row).most_common(1)[0][0] for row in names[nearest].tolist()]
    return found


def bones_percent(motion: Float[np.ndarray, "T 22 3"]) -> float:
    """Return the largest change of a bone's length over the motion, percent of it."""
    lengths = np.linalg.norm(motion[:, 1:] - motion[:, PARENTS[1:]], axis=-1)
    return float(100 * (np.ptp(lengths, axis=0) / lengths.mean(0)).max())


def slides(motion: Float[np.ndarray, "T 22 3"]) -> list[float]:
    """Return the ways of both resting feet, centimetres a frame."""
    feet = motion[:, [10, 11]]
    near = feet[..., 1] < feet[..., 1].min(0) + NEAR_GROUND
    ways = 100 * np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1)
    return ways[near[1:] & near[:-1]].tolist()


def diversity(group: Float[np.ndarray, "S T 22 3"]) -> float:
    """Return the mean distance of joints between two motions, centimetres."""
    pairs = itertools.combinations([placed(motion) for motion in group], 2)
    return float(100 * np.mean([np.linalg.norm(a - b, axis=-1).mean() for a, b in pairs]))


def row(title: str, drawn: Drawn, found: dict[str, list[str]]) -> tuple[str, ...]:
    """Return the numbers of some actions."""
    pairs = [(name, other) for name, others in found.items() for other in others]
    wrong = ", ".join(sorted({other for name, other in pairs if other != name})) or "–"
    flat = [motion for group in drawn.values() for motion in group]
    bones, ways = [*map(bones_percent, flat)], [*itertools.chain(*map(slides, flat))] or [0.0]
    share = sum(name == other for name, other in pairs) / len(pairs)
    return (
        title, f"{100 * share:.0f}", wrong, f"{np.mean(bones):.2f} / {max(bones):.2f}",
        f"{np.mean(ways):.2f} / {np.percentile(ways, 95):.2f}",
        f"{np.mean([*map(diversity, drawn.values())]):.1f}",
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--models", default=NAME, help="toybox, or the folder of an export")
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    fitted, fresh = generated(FITTED, 1), generated(FRESH, 2)
    drawn = sampled(str(Path(args.models)), args.seeds)
    found, own = recognised(fitted, drawn), recognised(fitted, fresh)
    rows = [row(name, {name: drawn[name]}, {name: found[name]}) for name in drawn]
    rows += [row("all", drawn, found), row("the generator", fresh, own)]
    columns = "action | recognised, % | taken for | bones, %, mean / most"
    columns += " | sliding, cm, mean / 95 % | between seeds, cm"
    print(markdown(columns.split(" | "), rows))


if __name__ == "__main__":
    main()
