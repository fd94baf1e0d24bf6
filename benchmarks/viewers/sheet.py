"""A sheet of what viewers show when a file is opened: one column per file.

    python -m benchmarks.viewers.sheet --modules ~/npm/node_modules sheet.png a.ply b.ply c.ply

First row: Spark, as in its examples, with the camera on +z. Second row: the page that
splat-transform makes, with its own first camera. ``benchmarks/viewers/browser.py`` says what to
install.
"""

import argparse
import math
from pathlib import Path

import numpy as np

from benchmarks.viewers.browser import (
    HALF_TURN_ABOUT_X,
    Camera,
    draw_with_spark,
    draw_with_splat_transform,
    missing,
)
from threestudio_gaussiandreamer.core.images import write

SIZE = 240
DISTANCE = 3.0
"""Of the camera from the middle of an object whose longest side is about 2."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sheet", type=Path, help="the PNG to write")
    parser.add_argument("clouds", type=Path, nargs="+")
    parser.add_argument("--modules", type=Path, required=True, help="the folder node_modules")
    arguments = parser.parse_args()
    if lacking := missing(arguments.modules):
        parser.error(lacking)
    c2w = np.eye(4)
    c2w[2, 3] = DISTANCE
    camera, modules = Camera(c2w, math.radians(50)), arguments.modules
    columns = []
    for cloud in arguments.clouds:
        (spark,) = draw_with_spark(cloud, [camera], SIZE, modules, rotation=HALF_TURN_ABOUT_X)
        page = draw_with_splat_transform(cloud, SIZE, modules)
        columns.append(np.concatenate([spark, page]))
    write(arguments.sheet, np.concatenate(columns, axis=1))


if __name__ == "__main__":
    main()
