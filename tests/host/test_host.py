"""The built-in host: registry, schedules, typed configurations, updates, savers, and the choice of
the host.
"""

import json
import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from threestudio_gaussiandreamer import host
from threestudio_gaussiandreamer.core import images as pictures
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.interpolation import escape
from threestudio_gaussiandreamer.core.schedule import C, C_max, validate_schedule
from threestudio_gaussiandreamer.host.builtin import registry
from threestudio_gaussiandreamer.host.builtin.base import (
    BaseModule,
    BaseObject,
    Updateable,
    parse_structured,
)
from threestudio_gaussiandreamer.host.builtin.models import (
    BaseGeometry,
    NoMaterial,
    Renderer,
    SolidColorBackground,
)
from threestudio_gaussiandreamer.host.builtin.savers import SaverMixin
from threestudio_gaussiandreamer.host.builtin.system import (
    BaseLift3DSystem,
    BaseSystem,
    optimizer_from,
)

# -- registry --------------------------------------------------------------------------------------


@pytest.fixture
def own_registry(monkeypatch):
    monkeypatch.setattr(registry, "_parts", {})
    return registry


def test_a_class_is_found_by_its_name_and_may_be_entered_twice(own_registry):
    part = type("Part", (), {})
    assert own_registry.register("some-part")(part) is part
    own_registry.register("some-part")(part)
    assert own_registry.find("some-part") is part
    assert own_registry.names() == ["some-part"]


def test_the_same_class_of_a_module_that_runs_again_takes_its_place(own_registry):
    first, second = (type("Part", (), {"__module__": "plugin"}) for _ in range(2))
    own_registry.register("some-part")(first)
    own_registry.register("some-part")(second)
    assert own_registry.find("some-part") is second


def test_another_class_under_a_taken_name_is_an_error(own_registry):
    own_registry.register("some-part")(type("Part", (), {}))
    with pytest.raises(UserError, match="'some-part' is taken by .*Part"):
        own_registry.register("some-part")(type("Other", (), {}))


def test_an_unknown_name_lists_the_near_ones(own_registry):
    own_registry.register("mesh-prior")(object)
    with pytest.raises(UserError, match="unknown part 'mesh-piror': did you mean 'mesh-prior'"):
        own_registry.find("mesh-piror")


def test_mixins_come_before_the_main_class(own_registry):
    main, mixin = type("Main", (), {"kind": "main"}), type("Mixin", (), {"kind": "mixin"})
    own_registry.register("main")(main)
    own_registry.register("mixin")(mixin)
    assert own_registry.find("main:mixin").kind == "mixin"
    assert issubclass(own_registry.find("main:mixin"), main)


# -- schedules -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "step", "expected"),
    [
        (0.5, 7, 0.5),
        (3, 7, 3),
        ([1.0, 3.0, 10], 0, 1.0),
        ([1.0, 3.0, 10], 5, 2.0),
        ([1.0, 3.0, 10], 99, 3.0),
        ((4, 1.0, 3.0, 8), 4, 1.0),
        ((4, 1.0, 3.0, 8), 6, 2.0),
        # the paper's switch of the largest timestep
        ([500, 0.98, 0.55, 501], 500, 0.98),
        ([500, 0.98, 0.55, 501], 501, 0.55),
        # the released code's clipping: three knots at 0, 1000, 2000
        ([0, 1.5, 2.0, 1000, 3.0, 2000], 500, 1.75),
        ([0, 1.5, 2.0, 1000, 3.0, 2000], 1500, 2.5),
        ([0, 1.5, 2.0, 1000, 3.0, 2000], 5000, 3.0),
        (OmegaConf.create([1.0, 3.0, 10]), 5, 2.0),
    ],
)
def test_schedule_by_step(value, step, expected):
    assert C(value, epoch=0, global_step=step) == pytest.approx(expected, abs=1e-12)


def test_a_fractional_end_counts_epochs():
    assert C([0, 0.0, 1.0, 10.0], epoch=5, global_step=9999) == 0.5
    assert C([0, 0.0, 1.0, 10], epoch=5, global_step=2) == 0.2


def test_exponential_interpolation_is_the_geometric_mean_half_way():
    assert C([0, 1.0, 100.0, 10], 0, 5, interpolation="exp") == pytest.approx(10.0)


@pytest.mark.parametrize(
    "value",
    [
        "0.5",
        None,
        True,
        [],
        [1.0],
        [1.0, 2.0],
        [0, 1.0, 2.0, 10, 3.0],
        [0, 1.0, 2.0, 10, 3.0, 20, 4.0],
        [5, 1.0, 2.0, 5],
        [0, 1.0, 2.0, 20, 3.0, 10],
        [1.0, 2.0, 0],
        [0, "a", 2.0, 10],
        [0, True, 2.0, 10],
        [0, math.nan, 2.0, 10],
        math.inf,
        {"a": 1},
        [0, 1.0, 2.0, 10, 3.0, 20.0],
    ],
)
def test_anything_else_is_no_schedule(value):
    with pytest.raises(UserError, match="grad_clip"):
        validate_schedule(value, "grad_clip")
    with pytest.raises(UserError):
        C(value, 0, 0)


@given(st.lists(st.floats(-10, 10), min_size=3, max_size=6), st.integers(-5, 80))
def test_a_piecewise_schedule_is_numpys_interpolation(values, step):
    steps = [10 * i for i in range(len(values))]
    knots = [steps[0], values[0]] + [
        x for pair in zip(values[1:], steps[1:], strict=True) for x in pair
    ]
    # exact up to the rounding of one multiplication
    assert C(knots, 0, step) == pytest.approx(np.interp(step, steps, values), abs=1e-12)
    assert C_max(knots) == max(values)


# -- configurations --------------------------------------------------------------------------------


@dataclass
class Options:
    size: int = 3
    text: str = ""
    rates: Any = 0.1
    inner: dict = field(default_factory=dict)


def test_values_are_typed_and_defaults_filled():
    cfg = parse_structured(Options, {"size": "5", "rates": [1, 2, 3]})
    assert cfg.size == 5 and list(cfg.rates) == [1, 2, 3] and cfg.text == ""
    assert parse_structured(Options).size == 3


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"szie": 3}, "unknown key 'szie': did you mean 'size'"),
        ({"size": "big"}, "size: Value 'big'"),
        ({"inner": 3}, "inner"),
        ("size", "expected keys and values"),
    ],
)
def test_a_mistake_in_a_configuration_is_named(values, message):
    with pytest.raises(UserError, match=message):
        parse_structured(Options, values)


@given(st.text(alphabet="ab\\${} :#[]", max_size=12))
def test_strings_are_text_whatever_they_look_like(text):
    assert OmegaConf.create({"x": escape(text)}).x == text
    cfg = parse_structured(Options, {"text": text, "inner": {"prompt": text}})
    assert cfg.text == text and cfg.inner.prompt == text
    # a part hands a section of its own configuration on
    assert (
        parse_structured(Options, {"text": cfg.inner.prompt, "inner": cfg.inner}).inner.prompt
        == text
    )


# -- parts -----------------------------------------------------------------------------------------


class Counter(BaseObject):
    def configure(self, *, inner: Any = None) -> None:
        self.inner, self.steps, self.ends = inner, [], []

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        self.steps.append((epoch, global_step, on_load_weights))

    def update_step_end(self, epoch: int, global_step: int) -> None:
        self.ends.append((epoch, global_step))


def test_updates_reach_parts_inside_parts():
    outer = Counter({}, inner=Counter({}))
    outer.do_update_step(1, 7)
    outer.do_update_step_end(1, 7)
    assert outer.inner.steps == outer.steps == [(1, 7, False)] and outer.inner.ends == [(1, 7)]


def test_updates_reach_parts_inside_modules():
    class Holder(BaseModule):
        def configure(self) -> None:
            self.child = BaseModule()
            self.child.counter = Counter({})

    holder = Holder({})
    holder.do_update_step(0, 3, on_load_weights=True)
    assert holder.child.counter.steps == [(0, 3, True)]


class Points(BaseGeometry):
    def configure(self) -> None:
        self.means = torch.nn.Parameter(torch.zeros(2))


def test_weights_of_one_module_are_loaded_from_a_checkpoint(tmp_path):
    state = {"geometry.means": torch.tensor([1.0, 2.0]), "background.color": torch.ones(3)}
    save_file(tmp_path / "a.ckpt", {"state_dict": state, "epoch": 1, "global_step": 7})
    assert Points({"weights": f"{tmp_path / 'a.ckpt'}:geometry"}).means.tolist() == [1.0, 2.0]
    with pytest.raises(UserError, match="no parameters of 'nothing'"):
        Points({"weights": f"{tmp_path / 'a.ckpt'}:nothing"})


def test_a_renderer_refers_to_its_parts_without_owning_them():
    geometry = Points()
    renderer = Renderer(
        {"radius": 2.0}, geometry=geometry, material=NoMaterial(), background=SolidColorBackground()
    )
    assert renderer.geometry is geometry
    assert list(renderer.state_dict()) == ["bbox"] and renderer.bbox.tolist() == [
        [-2.0] * 3,
        [2.0] * 3,
    ]


def test_a_solid_background_has_one_colour_everywhere():
    background = SolidColorBackground(
        {"color": [0.25, 0.5, 1.0], "random_aug": True, "random_aug_prob": 1.0}
    )
    dirs = torch.zeros(2, 4, 5, 3)
    assert background.eval()(dirs).shape == (2, 4, 5, 3)
    assert background(dirs)[1, 3, 4].tolist() == [0.25, 0.5, 1.0]
    torch.manual_seed(0)
    assert background.train()(dirs)[1, 3, 4].tolist() != [0.25, 0.5, 1.0]


def test_a_learned_background_gets_gradients():
    background = SolidColorBackground({"learned": True})
    background(torch.zeros(1, 2, 2, 3)).sum().backward()
    assert background.env_color.grad.tolist() == [4.0, 4.0, 4.0]


# -- the system ------------------------------------------------------------------------------------


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
    System({"weights": str(tmp_path / "a.ckpt"), "weights_ignore_modules": ["x"]}, resumed=True)
    assert calls == [("configure", True, None), ("post_configure", [1.0, 2.0])]


def test_the_step_of_a_resumed_checkpoint_is_the_true_one():
    system = BaseSystem({})
    assert (system.true_current_epoch, system.true_global_step) == (0, 0)
    system.set_resume_status(2, 1200)
    assert (system.true_current_epoch, system.true_global_step) == (2, 1200)
    assert system.C([0, 0.0, 1.0, 2400]) == 0.5


def test_an_exporter_output_that_nobody_can_save_is_named(own_registry, tmp_path):
    from threestudio_gaussiandreamer.host.builtin.models import Exporter, ExporterOutput

    class System(BaseLift3DSystem):
        def configure(self) -> None:
            self.exporter = Exporter({}, geometry=None, material=None, background=None)
            self.exporter.__class__ = type(
                "Odd", (Exporter,), {"__call__": lambda self: [ExporterOutput("a", "hologram", {})]}
            )

    with pytest.raises(UserError, match="has no save_hologram, which Odd asks for"):
        System({}).on_predict_epoch_end()


def test_optimizer_groups_are_named_attributes_with_their_own_options():
    module = torch.nn.Module()
    module.geometry = Points()
    config = OmegaConf.create(
        {"name": "Adam", "args": {"lr": 0.1}, "params": {"geometry.means": {"lr": 0.5}}}
    )
    groups = optimizer_from(config, module).param_groups
    assert [(group["name"], group["lr"]) for group in groups] == [("geometry.means", 0.5)]
    with pytest.raises(UserError, match="system.optimizer.params.geometry.maens"):
        optimizer_from(OmegaConf.create({"name": "Adam", "params": {"geometry.maens": {}}}), module)
    with pytest.raises(UserError, match="system.optimizer.name is 'Adma'"):
        optimizer_from(OmegaConf.create({"name": "Adma"}), module)


# -- savers ----------------------------------------------------------------------------------------


@pytest.fixture
def saver(tmp_path):
    saver = SaverMixin()
    saver.set_save_dir(str(tmp_path / "save"))
    return saver


def test_saving_without_a_folder_is_our_own_mistake():
    with pytest.raises(ValueError, match="set_save_dir"):
        SaverMixin().get_save_path("a.png")


def test_colours_come_back_from_the_file(saver):
    image = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.5, 2.0]]])
    path = saver.save_rgb_image("it3-0.png", image)
    assert iio.imread(path).tolist() == [[[255, 0, 0], [0, 128, 255]]]
    assert path.endswith("save/it3-0.png")
    path = saver.save_rgb_image("deep/er/chw.png", image.permute(2, 0, 1), data_format="CHW")
    assert iio.imread(path).tolist() == [[[255, 0, 0], [0, 128, 255]]]


def test_more_channels_are_laid_side_by_side():
    four = pictures.rgb(np.ones((2, 3, 4)))
    assert four.shape == (2, 6, 3)
    assert four[0, 2].tolist() == [255, 255, 255] and four[0, 5].tolist() == [255, 0, 0]


def test_grayscale_is_stretched_or_kept_and_a_constant_is_black():
    values = np.array([[1.0, 3.0]])
    assert pictures.grayscale(values, cmap=None)[..., 0].tolist() == [[0, 255]]
    assert pictures.grayscale(values, data_range=(0, 4), cmap=None)[..., 0].tolist() == [[64, 191]]
    assert pictures.grayscale(np.full((1, 2), 7.0), cmap=None).max() == 0
    assert pictures.grayscale(np.array([[np.nan, 1.0]]), cmap=None)[..., 0].tolist() == [[0, 255]]
    assert pictures.grayscale(values, cmap="jet")[0].tolist() == [[0, 0, 128], [128, 0, 0]]


def test_a_grid_has_cells_of_one_size_and_rows(saver):
    small = {"type": "rgb", "img": torch.ones(2, 2, 3), "kwargs": {"data_format": "HWC"}}
    large = {
        "type": "grayscale",
        "img": torch.eye(4),
        "kwargs": {"cmap": None, "data_range": (0, 1)},
    }
    assert iio.imread(saver.save_image_grid("row.png", [small, large])).shape == (4, 8, 3)
    assert iio.imread(saver.save_image_grid("min.png", [small, large], align="min")).shape == (
        2,
        4,
        3,
    )
    rows = saver.save_image_grid("rows.png", [[small, large], [large]], align=6, texts=["a", "b"])
    assert iio.imread(rows).shape == (12, 12, 3)


def test_a_video_of_odd_pictures_has_even_size_and_numeric_order(saver):
    for i in (10, 2, 1):
        saver.save_rgb_image(f"it3-test/{i}.png", np.full((33, 17, 3), i / 10))
    path = saver.save_img_sequence("it3-test", "it3-test", r"(\d+)\.png", fps=10)
    frames = iio.imread(path, plugin="FFMPEG")
    assert path.endswith("it3-test.mp4") and frames.shape == (3, 34, 18, 3)
    boxes = Path(path).read_bytes()
    assert boxes.index(b"moov") < boxes.index(b"mdat")  # a browser plays it while it loads
    assert iio.immeta(path, plugin="FFMPEG")["codec"] == "h264"
    assert iio.immeta(path, plugin="FFMPEG")["pix_fmt"].startswith("yuv420p")
    # H.264 rounds colours by a few levels; the order is what counts
    assert np.allclose(frames.mean((1, 2, 3)), [25.5, 51, 255], atol=6)
    assert (
        iio.imread(
            saver.save_img_sequence("turn", "it3-test", r"(\d+)\.png", save_format="gif")
        ).shape[0]
        == 3
    )


def test_a_video_of_nothing_and_an_unknown_format_are_errors(saver):
    Path(saver.get_save_path("empty/x.txt")).touch()
    with pytest.raises(FileNotFoundError):
        saver.save_img_sequence("a", "empty", r"(\d+)\.png")
    with pytest.raises(UserError, match="unknown video format 'avi'"):
        saver.save_img_sequence("a", "empty", r"(\d+)\.png", save_format="avi")


def test_data_json_files_and_meshes_come_back(saver, tmp_path):
    assert np.load(saver.save_data("a", {"x": torch.arange(3)}))["x"].tolist() == [0, 1, 2]
    assert np.load(saver.save_data("b.npy", np.ones(2))).tolist() == [1, 1]
    assert json.loads(Path(saver.save_json("c.json", {"psnr": 30.5})).read_text()) == {"psnr": 30.5}
    assert (
        torch.load(saver.save_state_dict("d.ckpt", {"x": torch.ones(1)}), weights_only=True)["x"]
        == 1
    )
    (tmp_path / "source.bin").write_bytes(b"abc")
    assert Path(saver.save_file("copy.bin", tmp_path / "source.bin")).read_bytes() == b"abc"
    mesh = SimpleNamespace(
        v_pos=torch.eye(3), t_pos_idx=torch.tensor([[0, 1, 2]]), v_rgb=torch.ones(3, 3)
    )
    lines = Path(saver.save_obj("m", mesh, save_vertex_color=True)[0]).read_text().splitlines()
    assert lines[0] == "v 1 0 0 1 1 1" and lines[-1] == "f 1 2 3"
    assert (
        Path(saver.save_mesh("m.ply", torch.eye(3), torch.tensor([[0, 1, 2]]))).stat().st_size > 0
    )


def test_only_arrays_can_be_converted(saver):
    with pytest.raises(TypeError, match="got str"):
        saver.convert_data({"a": ["text"]})


# -- which host ------------------------------------------------------------------------------------


@pytest.fixture
def path_with_threestudio(tmp_path, monkeypatch):
    def make(content: str | None) -> None:
        (tmp_path / "threestudio").mkdir()
        if content is not None:
            (tmp_path / "threestudio" / "__init__.py").write_text(content)
        monkeypatch.syspath_prepend(tmp_path)

    monkeypatch.delitem(sys.modules, "threestudio", raising=False)
    yield make
    sys.modules.pop("threestudio", None)


def test_a_folder_called_threestudio_is_not_the_host(path_with_threestudio):
    path_with_threestudio(None)
    assert not host._threestudio_is_importable()


def test_a_threestudio_that_imports_is_the_host(path_with_threestudio):
    path_with_threestudio("def register(name): ...")
    assert host._threestudio_is_importable()


def test_a_broken_threestudio_is_an_error_with_its_cause(path_with_threestudio):
    path_with_threestudio("import no_such_cuda_library")
    with pytest.raises(
        UserError, match="can't be imported: No module named 'no_such_cuda_library'"
    ):
        host._threestudio_is_importable()


def test_every_promised_name_is_there():
    assert [name for name in host.__all__ if not hasattr(host, name)] == []
    assert isinstance(Counter({}), Updateable)
