"""Draw 100 objects of the toybox: ``python -m tools.toybox_world FILE.png``."""

import sys
from pathlib import Path

import numpy as np

from threestudio_gaussiandreamer import images
from threestudio_gaussiandreamer.core.streams import numpy_generator
from threestudio_gaussiandreamer.toybox.demo import contact_sheet
from threestudio_gaussiandreamer.toybox.tokens import view_prompts
from threestudio_gaussiandreamer.toybox.views import Shards, with_backgrounds


def world_sheet(count: int = 100) -> np.ndarray:
    """Draw the first ``count`` objects, a view of each, with a prompt below it."""
    shard = Shards(Path(), 0, objects=count, views=1).make(0)
    rng = numpy_generator(0, "toybox-sheet")
    prompts = view_prompts(shard, np.arange(count), rng)
    return contact_sheet(with_backgrounds(shard.rgba, rng, random_share=0), prompts)


if __name__ == "__main__":
    images.write(sys.argv[1], world_sheet())
