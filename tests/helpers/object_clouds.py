"""Clouds like those of objects: small flat Gaussians on a bumpy ball, coloured by place."""

import numpy as np

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians


def ball(count: int = 600, degree: int = 0, seed: int = 0) -> Gaussians:
    """Draw Gaussians on a ball of radius about 0.5 that looks different from every side."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True) + 1e-12
    means = directions * (0.5 + 0.1 * np.sin(5 * directions[:, :1])) * [0.8, 1.0, 1.2]
    colors = 0.5 + 0.4 * np.sin(4 * directions + [0, 1, 2])
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.08
    sh[:, 0] = (colors - 0.5) / 0.28209479
    quats, log_scales = rng.normal(size=(count, 4)), np.log(0.02 + 0.05 * rng.random((count, 3)))
    values = means, quats, log_scales, rng.normal(size=count) + 2, sh
    return Gaussians(*(np.asarray(value, np.float32) for value in values))


def in_order_of(ours: Gaussians, theirs: Gaussians) -> Gaussians:
    """Return the rows of ``ours`` in the order in which ``theirs`` has them, by place and size."""
    known, found = (np.concatenate([c.means, c.log_scales], axis=1) for c in (ours, theirs))
    rows = [np.abs(known - row).sum(axis=1).argmin() for row in found]
    assert sorted(rows) == list(range(len(known)))
    return ours.rows(rows)


def assert_close(ours: Gaussians, theirs: Gaussians, **tolerances: float) -> None:
    """Compare what is drawn: means, rotations up to sign, log_scales, opacities, sh.

    Args:
        tolerances: largest absolute difference by name; 1e-5 for those that aren't given.
    """

    def compare(name: str, a: np.ndarray, b: np.ndarray) -> None:
        np.testing.assert_allclose(a, b, atol=tolerances.get(name, 1e-5), rtol=0, err_msg=name)

    compare("means", ours.means, theirs.means)
    compare("log_scales", ours.log_scales, theirs.log_scales)
    compare("opacities", *(1 / (1 + np.exp(-c.logit_opacities)) for c in (ours, theirs)))
    compare("sh", ours.sh, theirs.sh)
    units = [c.quats / np.linalg.norm(c.quats, axis=1, keepdims=True) for c in (ours, theirs)]
    compare("quats", np.abs((units[0] * units[1]).sum(axis=1)), np.ones(len(ours.means)))
