"""``--typecheck`` checks arrays against their annotations and ignores everything else."""

import subprocess
import sys
from pathlib import Path
from typing import Any, List, Optional, Union

import numpy as np
import pytest
import torch
from jaxtyping import Float, Int, jaxtyped
from torch import Tensor

from threestudio_gaussiandreamer.core.typecheck import check, matches

REPOSITORY = Path(__file__).resolve().parents[2]
POINTS = torch.zeros(5, 3)


@pytest.mark.parametrize(
    ("value", "annotation", "fits"),
    [
        (POINTS, Float[Tensor, "N 3"], True),
        (POINTS, Float[Tensor, "N 4"], False),
        (POINTS.int(), Float[Tensor, "N 3"], False),
        (POINTS.numpy(), Float[Tensor, "N 3"], False),
        (POINTS.numpy(), Float[np.ndarray, "N 3"], True),
        (None, Optional[Float[Tensor, "N 3"]], True),
        (POINTS, Optional[Float[Tensor, "N 4"]], False),
        (0.5, Union[float, Float[Tensor, "N"]], True),
        ("a", Union[float, Float[Tensor, "N"]], False),
        (POINTS.int(), Float[Tensor, "N 3"] | Int[Tensor, "N 3"], True),
        ((POINTS, POINTS), tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], True),
        ((POINTS,), tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], False),
        ("anything", int, True),
        ([1, 2], List[str], True),
        (3, Any, True),
    ],
)
def test_arrays_match_their_annotations_and_all_else_does(value, annotation, fits):
    assert matches(value, annotation) is fits


def test_dimensions_with_the_same_name_are_the_same():
    @jaxtyped(typechecker=check)
    def paint(
        means: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"], *, scale: float = 1
    ) -> Float[Tensor, "N 3"]:
        return means[:-1] if scale == 2 else means

    assert paint(POINTS, POINTS, scale="left alone").shape == (5, 3)
    with pytest.raises(TypeError, match="colors"):
        paint(POINTS, POINTS[:4])
    with pytest.raises(TypeError, match="return value"):
        paint(POINTS, POINTS, scale=2)


@pytest.mark.slow
def test_the_hook_watches_the_package():
    code = """
import threestudio_gaussiandreamer.core.typecheck as typecheck
typecheck.install()
import torch
from threestudio_gaussiandreamer.diffusion.sds import diffuse
try:
    diffuse("not a tensor", torch.ones(1), torch.ones(1))
except TypeError as error:
    print(type(error).__name__)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.stdout == "TypeCheckError\n", done.stdout + done.stderr


@pytest.mark.slow
def test_a_run_that_exports_and_prunes_passes_the_checks(tmp_path):
    options = ["system.geometry.densify.enabled=true", "system.prune.count=100"]
    options += ["system.exporter.formats=[ply,spz,sog,points,glb,compressed-ply,surface,usda]"]
    command = [sys.executable, "launch.py", "--config", "smoke.yaml", "--train", "--typecheck"]
    command += ["--gpu", "cpu", f"exp_root_dir={tmp_path}", *options]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
