"""The picture of README.md: kept runs of withheld prompts, beside the prior and the 2D model.

    python -m benchmarks.quality.toybox --charts default --keep FOLDER
    python -m benchmarks.quality.toybox_sheet --keep FOLDER

It shows the first prompts of the benchmark, so none is chosen.
"""

import argparse
from pathlib import Path

import torch
from tqdm import tqdm

from benchmarks.quality.runs import ROOT
from benchmarks.quality.toybox import RUN, Task, kept, prepare
from benchmarks.quality.toybox_jobs import DEFAULT, Variant, prompts
from threestudio_gaussiandreamer.core import images
from threestudio_gaussiandreamer.evaluation.text_to_3d import Scores
from threestudio_gaussiandreamer.models.bundled import NAME
from threestudio_gaussiandreamer.toybox.demo import stages_of
from threestudio_gaussiandreamer.toybox.sheet import contact_sheet

OUT = ROOT / "docs/images/toybox-results.jpg"
CELLS = (("prior", 0), ("result", 0), ("result", 1), ("2D model", 0))
"""Stage and view of the pictures of one prompt: from the front, and for the result from the left.
"""
PROMPTS_PER_ROW = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", type=Path, required=True, help="folder of the kept runs")
    parser.add_argument("--models", default=NAME, help="toybox, or the folder of an export")
    parser.add_argument("--count", type=int, default=20, help="of prompts")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    prepare()
    scores, pictures, texts = Scores(arguments.models), [], []
    for prompt in tqdm(prompts("withheld", arguments.count), unit="prompt"):
        task = Task(Variant(DEFAULT), prompt, 0, arguments.models, arguments.keep)
        stages = stages_of(prompt.text, kept(task) / RUN, arguments.models, scores)
        pictures += [stages.pictures[name][view] for name, view in CELLS]
        texts += ["prior", f"result: {prompt.text}", "", "2D model"]
    columns = PROMPTS_PER_ROW * len(CELLS)
    images.write(arguments.out, contact_sheet(torch.stack(pictures), texts, columns=columns))
    print(arguments.out)


if __name__ == "__main__":
    main()
