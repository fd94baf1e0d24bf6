"""Helpers of the prior tests."""

import numpy as np

from threestudio_gaussiandreamer.host import find


def rng(seed=0):
    return np.random.default_rng(seed)


# Needed options of each registered prior; a new prior is one row here.
OPTIONS = {
    "mesh-prior": {"path": "box.ply"},
    "body-prior": {"path": "body.obj", "num_points": 2000},
    "point-cloud-prior": {"path": "points.ply"},
    "gaussians-prior": {"path": "gaussians.ply"},
    "random-prior": {"num_points": 500},
}


def build(name, assets, **options):
    options = {**OPTIONS.get(name, {}), **options}
    if "path" in options:
        options["path"] = str(assets / options["path"])
    return find(name)(options)
