"""Figures in the prose of README.md and docs/: constants of the code, or published by others.

Measurements belong into the generated sections, which ``tests/test_docs.py`` compares with the
CSVs.
"""

import inspect
import re

import pytest

from benchmarks.robustness.fuzz import ROOM
from benchmarks.splatting.gpu_kernels import COMPARISON_AIM
from benchmarks.splatting.gpu_training import REST_AIM
from tests.fuzz import runner
from tests.launch.test_ddp import TOLERANCE
from tests.test_docs import TEXTS
from threestudio_gaussiandreamer import metrics
from threestudio_gaussiandreamer.core import file_memory
from threestudio_gaussiandreamer.evaluation import intervals
from threestudio_gaussiandreamer.gaussians import simplify
from threestudio_gaussiandreamer.launch.config_source import MOST_DEPTH, MOST_NODES
from threestudio_gaussiandreamer.launch.live_viewer import SHARE_OF_TIME
from threestudio_gaussiandreamer.meshes import budget
from threestudio_gaussiandreamer.priors.motion import MotionPrior
from threestudio_gaussiandreamer.prune import PruneOptions
from threestudio_gaussiandreamer.splatting.cuda.memory import LIST_BYTES, ROW_BYTES
from threestudio_gaussiandreamer.surface.options import MeshOptions
from threestudio_gaussiandreamer.training.density_options import PruneConfig

GENERATED = {"docs/results.md", "docs/stability.md"}
FIGURE = re.compile(
    r"\d[\d,.]*\s(?:dB|ms|seconds?|minutes?|hours?|MB|GB|MiB|GiB|kB|KB|TFLOP|mm|%|times)(?!\w)"
)
FLOATERS = inspect.signature(metrics.floater_mass).parameters["share"].default
CONSTANTS = {
    "docs/several_processes.md": [f"within {TOLERANCE:g} dB"],
    "docs/cuda.md": [
        f"take {LIST_BYTES} bytes per intersection, the backward pass {ROW_BYTES} more",
        f"The aim of {100 * REST_AIM:g} % of the U-Net's time",
        f"its aim of {1000 * COMPARISON_AIM:g} ms",
    ],
    "docs/failures.md": [f"farther than {FLOATERS:.0%}".replace("%", " %")],
    "docs/evaluation.md": [f"its {intervals.LEVEL:.0%} bootstrap".replace("%", " %")],
    "docs/viewing.md": [f"at most {SHARE_OF_TIME:.0%}".replace("%", " %")],
    "docs/mesh.md": [f"Parts below {MeshOptions.min_component:.0%}".replace("%", " %")],
    "docs/models.md": [f"`max_residual_mm` ({MotionPrior.Config.max_residual_mm:g})"],
    "docs/pruning.md": [
        f"for {PruneOptions.steps} steps",
        f"the best {PruneConfig.keep:g} are kept",
        f"of more than {simplify.LARGE:,} Gaussians",
        f"({simplify.LOSSLESS:g} dB to the original, or {simplify.RESERVE:g} dB above",
    ],
    "docs/robustness.md": [
        f"more than {runner.SECONDS:g} seconds of CPU time",
        f"at most {runner.FIXED_BYTES >> 20} MiB plus {runner.PER_BYTE} times the file size",
        f"limits the address space to {ROOM >> 30} GiB",
        f"at most {MOST_DEPTH} levels and {MOST_NODES:,} values",
        f"checked against {file_memory.FIXED_BYTES >> 20} MiB plus "
        f"{file_memory.BYTES_PER_FILE_BYTE} times the file",
        f"may take {budget.FIXED_BYTES >> 20} MiB plus "
        f"{budget.BYTES_PER_FILE_BYTE} times the files",
    ],
}
PUBLISHED = {
    "docs/evaluation.md": ["100 times the cosine", "428 M, 1.7 GB", "2.5 G, 10 GB"],
    "docs/models.md": [
        "1.7 + 0.2 GB, text encoder 1.4 GB",
        "8.6 + 9.5 GB",
        "1.3 + 0.9 + 0.5 GB in float32",
        "| 1.3 GB, about 3.8 with",
        "0.16 GB each",
        "| 0.16 GB, about 0.5 with",
        "| 1.7 GB |",
        "0.1 to 0.4 GB",
        "wheel 0.05 GB; its dependency warp-lang, which isn't used, 0.15 GB",
        "the paper's 15 minutes on an RTX 3090",
    ],
}


def prose(name: str) -> str:
    """Return a page without its generated sections and code, with single spaces."""
    text = re.sub(r"<!-- (?!end)[\w ]+ -->.*?<!-- end -->", "", TEXTS[name], flags=re.DOTALL)
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return " ".join(text.split())


@pytest.mark.parametrize(
    ("name", "phrase"), [(name, phrase) for name, found in CONSTANTS.items() for phrase in found]
)
def test_a_constant_in_the_docs_is_the_one_of_the_code(name, phrase):
    assert phrase in prose(name)


@pytest.mark.parametrize("name", sorted(set(TEXTS) - GENERATED))
def test_no_measured_figure_is_typed_by_hand(name):
    text = prose(name)
    for phrase in CONSTANTS.get(name, []) + PUBLISHED.get(name, []):
        assert phrase in text, f"{name} doesn't contain {phrase!r} any more"
        text = text.replace(phrase, "")
    assert not FIGURE.findall(text)
