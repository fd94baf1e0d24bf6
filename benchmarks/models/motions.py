"""The text-to-motion model alone: what its samples show, how steady its bones and feet are.

    python -m benchmarks.models.motions                       # the bundled model
    python -m benchmarks.models.motions --models FOLDER       # an export

Each action is sampled with several seeds, in another wording each. The action, with its side, is
recognised by the nearest of the generator's motions; the last row has fresh ones of the generator.
A foot rests while it is within 2 cm of its lowest height; it slides by its way on the ground to the
next frame. Between seeds is the mean distance of joints.
"""

import argparse
import itertools
from collections import Counter

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from benchmarks.markdown import markdown
from threestudio_gaussiandreamer.models.bundled import MOTION, NAME, model_part
from threestudio_gaussiandreamer.models.clip import clip_source, text_features
from threestudio_gaussiandreamer.priors import text_to_motion as t2m
from threestudio_gaussiandreamer.priors.body_pose import PARENTS
from threestudio_gaussiandreamer.toybox import motions

NAMES = motions.names()
FITTED, FRESH, SEEDS, NEIGHBOURS = 40, 20, 5, 5
"""Motions of each action that classify, that validate, samples, and nearest ones that vote."""
COLUMNS = "action", "recognised, %", "taken for", "bones, %", "sliding, cm", "between seeds, cm"
"""Of bones mean and most, of sliding mean and 95 %."""
Drawn = dict[str, Float[np.ndarray, "S T 22 3"]]


def generated(count: int, seed: int) -> Drawn:
    """Return motions of the generator."""
    rng, n = np.random.default_rng(seed), t2m.FRAMES
    positions = {name: [motions.draw(name, rng, n)[0] for _ in range(count)] for name in NAMES}
    return {name: np.stack(group) for name, group in positions.items()}


def sampled(models: str, count: int) -> Drawn:
    """Return samples of the model."""
    model, clip, found = t2m.load_motion_model(model_part(models, MOTION)), clip_source(models), {}
    for name in NAMES:
        action, side = motions.split(name)
        phrases = itertools.islice(itertools.cycle(motions.ACTIONS[action].phrases), count)
        texts = [text_features(clip, f"Someone {phrase.format(side)}") for phrase in phrases]
        rng = torch.Generator().manual_seed(0)
        found[name] = t2m.sample_motions(model, torch.cat(texts), count, rng)
    return found


def placed(motion: Float[np.ndarray, "T 22 3"]) -> Float[np.ndarray, "T 22 3"]:
    """Return a motion that starts above the origin and looks along +z in the mean of its frames."""
    x, _, z = (motion[:, [1, 16]] - motion[:, [2, 17]]).sum((0, 1))
    c, s = np.array([x, z]) / np.hypot(x, z)
    return (motion - motion[0, 0] * [1, 0, 1]) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def looks(motion: Float[np.ndarray, "T 22 3"]) -> Float[np.ndarray, " D"]:
    """Return mean, deviation and extremes of the joints' coordinates around the pelvis' place."""
    motion = placed(motion)
    local = (motion - motion[:, :1] * [1, 0, 1]).reshape(len(motion), -1)
    return np.concatenate([of(local, axis=0) for of in (np.mean, np.std, np.min, np.max)])


def recognised(fitted: Drawn, drawn: Drawn) -> dict[str, list[str]]:
    """Return the action of each motion by the vote of the nearest fitted ones."""
    tree = cKDTree([looks(motion) for group in fitted.values() for motion in group])
    names, found = np.repeat(NAMES, FITTED), {}
    for name, group in drawn.items():
        _, nearest = tree.query([looks(motion) for motion in group], NEIGHBOURS)
        found[name] = [Counter(row).most_common(1)[0][0] for row in names[nearest].tolist()]
    return found


def row(title: str, drawn: Drawn, found: dict[str, list[str]]) -> tuple[str, ...]:
    """Return the numbers of some actions."""
    pairs, bones, ways, apart = [], [], [0.0], []
    for name, group in drawn.items():
        pairs += [(name, other) for other in found[name]]
        lengths = np.linalg.norm(group[:, :, 1:] - group[:, :, PARENTS[1:]], axis=-1)
        bones += (100 * np.ptp(lengths, axis=1) / lengths.mean(1)).max(1).tolist()
        feet = group[:, :, [10, 11]]
        near = feet[..., 1] < feet[..., 1].min(1, keepdims=True) + 0.02
        steps = 100 * np.linalg.norm(np.diff(feet[..., [0, 2]], axis=1), axis=-1)
        ways += steps[near[:, 1:] & near[:, :-1]].tolist()
        for a, b in itertools.combinations([placed(motion) for motion in group], 2):
            apart.append(100 * np.linalg.norm(a - b, axis=-1).mean())
    wrong = ", ".join(sorted({other for name, other in pairs if other != name})) or "–"
    share = 100 * sum(name == other for name, other in pairs) / len(pairs)
    slide = f"{np.mean(ways):.2f} / {np.percentile(ways, 95):.2f}"
    most = f"{np.mean(bones):.2f} / {max(bones):.2f}"
    return title, f"{share:.0f}", wrong, most, slide, f"{np.mean(apart):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--models", default=NAME, help="toybox, or the folder of an export")
    fitted, fresh = generated(FITTED, 1), generated(FRESH, 2)
    drawn = sampled(parser.parse_args().models, SEEDS)
    found, own = recognised(fitted, drawn), recognised(fitted, fresh)
    rows = [row(name, {name: drawn[name]}, found) for name in NAMES]
    rows += [row("all", drawn, found), row("the generator", fresh, own)]
    print(markdown(COLUMNS, rows))


if __name__ == "__main__":
    main()
