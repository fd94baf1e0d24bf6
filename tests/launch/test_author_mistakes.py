"""Mistakes in a part of the user's own: one line that names the part and what was expected."""

from pathlib import Path

import pytest
import torch

from threestudio_gaussiandreamer.launch.experiment import main

TINY = [
    "trainer.max_steps=3", "trainer.val_check_interval=3", "data.width=16", "data.height=16",
    "data.eval_width=16", "data.eval_height=16", "data.n_test_views=2", "system.pages=false",
    "system.geometry.budget=none", "system.geometry.densify.enabled=false", "use_timestamp=false",
    "tag=t",
]  # fmt: skip


def run(source, *options):
    """Train with ``custom/part.py`` in the working folder; return the exit code."""
    Path("custom").mkdir(exist_ok=True)
    Path("custom/part.py").write_text(source)
    return main(["--config", "smoke.yaml", "--train", "--gpu", "cpu", *TINY, *options])


DENSITY = """
import torch
from threestudio_gaussiandreamer.gaussians.densify import highest, select, unchanged
from threestudio_gaussiandreamer.host import BaseObject, register
from threestudio_gaussiandreamer.training.density import DensityRule

@register("own-density")
class Own(DensityRule):
"""
OWN_DENSITY = "system.geometry.density_type=own-density"
REGULARISER = """
import torch
from threestudio_gaussiandreamer.host import register

@register("mine-regulariser")
"""


def test_own_parts_are_called_in_every_step(tmp_path, monkeypatch):
    """A density rule around the gradients, which those of a regulariser reach."""
    monkeypatch.chdir(tmp_path)
    rule = """
    def before_backward(self, pictures, step, error):
        self.calls = [pictures["comp_rgb"].requires_grad, step]
    def after_backward(self, out, width, height, loss_scale):
        self.calls += [out.means2d.grad is not None, width]
    def after_step(self, optimizer, step):
        self.calls += [step]
        open("calls", "a").write(f"{self.calls}\\n")
        count = len(self.cloud) - 10
        same = unchanged(self.cloud.parameters_by_name())
        change = select(same, highest(self.cloud.opacities().detach(), count))
        self.cloud.apply_change(change, optimizer)
"""
    regulariser = """
def own(out):
    sums = {name: out[name].sum() for name in ("means", "scales", "opacities")}
    open("shapes", "a").write(" ".join(str(tuple(out[name].shape)) for name in sums) + "\\n")
    return sum(sums.values())
"""
    # against the guidance's far smaller gradients: every opacity and size falls, x + y + z too
    rates = [f"system.geometry.lr_{name}=0.5" for name in ("means", "scales", "opacities")]
    source = DENSITY + rule + REGULARISER + regulariser
    assert run(source, OWN_DENSITY, "system.loss.lambda_mine=1e6", *rates) == 0
    expected = [f"[True, {n}, True, 16, {n + 1}]" for n in range(3)]
    assert Path("calls").read_text().splitlines() == expected
    assert Path("shapes").read_text().startswith("(300, 3) (300, 3) (300,)\n(290, 3)")
    ply = next(Path("outputs").rglob("gaussians.ply")).read_bytes()
    assert f"element vertex {300 - 30}".encode() in ply[:200]
    state = torch.load(next(Path("outputs").rglob("last.ckpt")), weights_only=True)["state_dict"]
    assert (state["geometry.logit_opacities"] < torch.logit(torch.tensor(0.1)) - 1).all()
    assert (state["geometry.means"].sum(1) < -3).all()
    assert state["geometry.log_scales"].median() < -3.9  # about -2.9 at the start


PART = """
import numpy as np
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import register
from threestudio_gaussiandreamer.{1} import {2}

@register("own-{0}")
class Own{0}({2}):
"""
OPTIONS = {
    "regulariser": "system.loss.lambda_mine=1",
    "name": "system.loss.lambda_smooth=1",
    "density rule": OWN_DENSITY,
    "prior": "system.geometry.prior_type=own-prior",
    "exporter": "system.exporter.formats=[own]",
    "geometry": "system.geometry_type=own-geometry",
}
MISTAKES = {
    "regulariser: a vector": (
        REGULARISER + "def own(out): return out['opacities']",
        "mine-regulariser returned (300,); expected one number",
    ),
    "name: without -regulariser": (
        REGULARISER.replace("mine-regulariser", "smooth") + "def own(out): return 0",
        "a regulariser of your own is a function below @register('smooth-regulariser')",
    ),
    "density rule: changes parameters without the optimiser": (
        DENSITY
        + """
    def after_step(self, optimizer, step):
        self.cloud.means = torch.nn.Parameter(self.cloud.means.detach())
""",
        "geometry.means isn't among the optimiser's parameters",
    ),
    "prior: an empty cloud": (
        PART.format("prior", "priors.base", "Prior")
        + """
    def generate(self, prompt, generator):
        return PointCloud(np.zeros((0, 3)), np.zeros((0, 3)))
""",
        "Ownprior gave no points",
    ),
    "exporter: returns nothing": (
        PART.format("exporter", "host", "Exporter") + "    def __call__(self): pass",
        "Ownexporter returned NoneType; expected a list of ExporterOutput",
    ),
    "geometry: forgot super().configure": (
        PART.format("geometry", "training.geometry", "GaussianCloud")
        + "    def configure(self, *parts, **more): self.mine = 1",
        "whose configure calls super().configure()",
    ),
    "density rule: no base class": (
        DENSITY.replace("Own(DensityRule)", "Own(BaseObject)") + "    pass",
        "expected a class that is derived from threestudio_gaussiandreamer.training.density.",
    ),
    "density rule: a hook with other arguments": (
        DENSITY + "    def after_step(self, optimizer): pass",
        "Own has after_step(self, optimizer), which is called as after_step(optimizer, step",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_that_names_the_part(mistake, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    source, message = MISTAKES[mistake]
    assert run(source, OPTIONS[mistake.partition(":")[0]]) == 2
    errors = capsys.readouterr().err
    assert message in errors and "Traceback" not in errors, errors
    assert sum(line.startswith("error: ") for line in errors.splitlines()) == 1
