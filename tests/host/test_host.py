"""The built-in host: registry, updates, parts and system; and the choice of the host."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer import host
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host.builtin import base as registry
from threestudio_gaussiandreamer.host.builtin import models
from threestudio_gaussiandreamer.host.builtin.system import BaseLift3DSystem, BaseSystem


def test_a_class_is_found_by_its_name_and_may_be_entered_again(monkeypatch):
    """Also one of a module that runs again; another one under a taken name is an error."""
    monkeypatch.setattr(registry, "_parts", {})
    first, second = (type("Part", (), {"__module__": "plugin"}) for _ in range(2))
    for part in (first, first, second):
        assert registry.register("some-part")(part) is registry.find("some-part") is part
    assert registry.names() == ["some-part"]
    refused("'some-part' is taken by .*Part", registry.register("some-part"), type("Other", (), {}))
    refused("unknown part 'some-prat': did you mean 'some-part'", registry.find, "some-prat")


class Counter(registry.BaseObject):
    def configure(self, *, inner: Any = None) -> None:
        self.inner, self.steps, self.ends = inner, [], []

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        self.steps.append((epoch, global_step, on_load_weights))

    def update_step_end(self, epoch: int, global_step: int) -> None:
        self.ends.append((epoch, global_step))


def test_updates_reach_parts_inside_parts_and_modules():
    class Holder(registry.BaseModule):
        def configure(self) -> None:
            self.child = registry.BaseModule()
            self.child.counter = Counter({})

    outer, holder = Counter({}, inner=Counter({})), Holder({})
    outer.do_update_step(1, 7)
    outer.do_update_step_end(1, 7)
    assert outer.inner.steps == outer.steps == [(1, 7, False)] and outer.inner.ends == [(1, 7)]
    holder.do_update_step(0, 3, on_load_weights=True)
    assert holder.child.counter.steps == [(0, 3, True)]


class Points(models.BaseGeometry):
    def configure(self) -> None:
        self.means = torch.nn.Parameter(torch.zeros(2))


def test_weights_of_one_module_are_loaded_from_a_checkpoint(tmp_path):
    state = {"geometry.means": torch.tensor([1.0, 2.0]), "background.color": torch.ones(3)}
    save_file(tmp_path / "a.ckpt", {"state_dict": state, "epoch": 1, "global_step": 7})
    assert Points({"weights": f"{tmp_path / 'a.ckpt'}:geometry"}).means.tolist() == [1.0, 2.0]
    refused("no parameters of 'nothing'", Points, {"weights": f"{tmp_path / 'a.ckpt'}:nothing"})
    state = {"geometry.means": torch.ones(3)}
    save_file(tmp_path / "b.ckpt", {"state_dict": state, "epoch": 1, "global_step": 7})
    with pytest.raises(UserError, match="b.ckpt:geometry don't fit these options .*size mismatch"):
        Points({"weights": f"{tmp_path / 'b.ckpt'}:geometry"})


def test_a_renderer_refers_to_its_parts_without_owning_them():
    parts = {"material": models.NoMaterial(), "background": models.SolidColorBackground()}
    renderer = models.Rasterizer({"radius": 2.0}, geometry=(geometry := Points()), **parts)
    assert renderer.geometry is geometry and list(renderer.state_dict()) == ["bbox"]
    assert renderer.bbox.tolist() == [[-2.0] * 3, [2.0] * 3]


def test_a_solid_background_has_one_colour_everywhere(caplog):
    background = models.SolidColorBackground({"color": [0.25, 0.5, 1.0], "random_aug": True})
    assert "random_aug is no option any more" in caplog.text
    drawn = background(torch.zeros(2, 4, 5, 3))
    assert drawn.shape == (2, 4, 5, 3) and drawn[1, 3, 4].tolist() == [0.25, 0.5, 1.0]
    learned = models.SolidColorBackground({"learned": True})
    learned(torch.zeros(1, 2, 2, 3)).sum().backward()
    assert learned.env_color.grad.tolist() == [4.0, 4.0, 4.0]


def test_a_system_configures_then_loads_weights_then_post_configures(tmp_path):
    calls = []

    class System(BaseSystem):
        def configure(self) -> None:
            calls.append(("configure", self.resumed, self._save_dir))
            self.geometry = Points()

        def post_configure(self) -> None:
            calls.append(("post_configure", self.geometry.means.tolist()))

    state = {"geometry.means": torch.tensor([1.0, 2.0]), "x.y": torch.ones(1)}
    save_file(tmp_path / "a.ckpt", {"state_dict": state, "epoch": 0, "global_step": 3})
    System({"weights": str(tmp_path / "a.ckpt")}, resumed=True)
    assert calls == [("configure", True, None), ("post_configure", [1.0, 2.0])]


def test_the_step_of_a_resumed_checkpoint_is_the_true_one():
    old = {"weights_ignore_modules": None, "cleanup_after_test_step": True}
    system = BaseSystem(old | {"cleanup_after_validation_step": False})
    assert (system.true_current_epoch, system.true_global_step) == (0, 0)
    system.set_resume_status(2, 1200)
    assert (system.true_current_epoch, system.true_global_step) == (2, 1200)
    assert system.C([0, 0.0, 1.0, 2400]) == 0.5


def test_an_output_that_the_system_cannot_write_is_named():
    class Odd:
        cfg = SimpleNamespace(save_video=False)

        def __call__(self):
            return [SimpleNamespace(save_type="txt")]

    with pytest.raises(UserError, match="SimpleNamespace has no save_txt, which Odd asks for"):
        BaseLift3DSystem.on_predict_epoch_end(SimpleNamespace(exporter=Odd()))


@pytest.mark.parametrize(
    ("content", "is_host"),
    [(None, False), ("def register(name): ...", True), ("import none", None)],
)
def test_threestudio_is_the_host_if_it_imports(tmp_path, monkeypatch, content, is_host):
    """Not a folder of its name; a broken one is an error with its cause."""
    # set, so that what the import leaves there is removed afterwards
    monkeypatch.setitem(sys.modules, "threestudio", None)
    del sys.modules["threestudio"]
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "threestudio").mkdir()
    if content is not None:
        (tmp_path / "threestudio/__init__.py").write_text(content)
    if is_host is None:
        refused("can't be imported: No module named 'none'", host._threestudio_is_importable)
    else:
        assert host._threestudio_is_importable() == is_host


THREESTUDIO_NAMES = """
    control4d-multiview-system custom-mesh deep-floyd-guidance deep-floyd-prompt-processor
    diffuse-with-point-light-material dreamfusion-system dummy-exporter dummy-prompt-processor
    efficient-dreamfusion-system fantasia3d-system gan-volume-renderer
    hybrid-rgb-latent-material image-condition-dreamfusion-system implicit-sdf implicit-volume
    instructnerf2nerf-system latentnerf-system magic123-system magic3d-system mesh-exporter
    nerf-volume-renderer neural-environment-map-background neural-radiance-material
    neus-volume-renderer no-material nvdiff-rasterizer patch-renderer pbr-material
    perceptual-loss prolificdreamer-system sd-latent-adapter-material sdi-system sjc-system
    solid-color-background stable-diffusion-controlnet-guidance stable-diffusion-guidance
    stable-diffusion-instructpix2pix-guidance stable-diffusion-prompt-processor
    stable-diffusion-sdi-guidance stable-diffusion-unified-guidance
    stable-diffusion-vsd-guidance stable-zero123-guidance tetrahedra-sdf-grid textmesh-system
    textured-background volume-grid zero123-guidance zero123-simple-system zero123-system
    zero123-unified-guidance
""".split()
"""Registered by threestudio 0.2.3, which refuses an extension that registers one of them again."""


def test_no_part_takes_a_name_of_threestudio():
    package = Path(host.__file__).parents[1]
    for path in package.rglob("*.py"):
        if "builtin" not in path.parts:
            taken = re.findall(r'@register\("([^"]+)"\)', path.read_text())
            assert not set(taken) & set(THREESTUDIO_NAMES), path
