"""Wrong values of options: one message, before any work."""

import copy
import dataclasses
import re
from dataclasses import dataclass

import pytest
import yaml
from omegaconf import OmegaConf

from tests.launch.cases import DEMO, SMALL, assert_refused
from threestudio_gaussiandreamer import host, register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import BaseBackground, BaseModule, BaseObject, register
from threestudio_gaussiandreamer.host.methods import require_dataclass
from threestudio_gaussiandreamer.launch import config_check
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config, check_part
from threestudio_gaussiandreamer.launch.parts import check_kind, find_part, load_extensions

register_parts()


@register("foo-guidance")
class FooGuidance(BaseObject):
    LOSSES = ("foo",)

    def __call__(self, rgb):
        return {"loss_foo": rgb.sum()}


@pytest.fixture(scope="module")
def demo():
    return load_config(DEMO, cli_args=SMALL)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("system.loss.lamda_sds=1", "weights of losses are called lambda_<loss>"),
        ("system.exporter.options.ply.pad_sh_degre=3", "did you mean 'options.ply.pad_sh_degree'"),
        ("system.exporter.options.ply.save_name=../x.ply", "save_name: expected the name of a"),
        ("system.guidance_type=exact-scores", "system.guidance_type: unknown part 'exact-scores'"),
        ("system.renderer_type=no-material", "needs gaussiandreamer-splatting, or a class"),
        ("system.material_type=gaussiandreamer-cloud", "a part of the kind geometry; expected one"),
        ("data_type=''", "data_type is ''; expected the name of a registered part (an overlay"),
        ("data_type=mesh-prior", "data_type is 'mesh-prior', a part of the kind prior; expected"),
        ("system.geometry.prior.color=3", "color: expected null, 'grey', 'random' or [red, green,"),
        ("data.resolution_milestones=[5]", "data.resolution_milestones: give height, width or"),
        ("system.geometry.prior.up=+w", "unknown up axis '+w'"),
        ("system.geometry.budget='12'", "a number from min_gaussians (64) on, got 12"),
        ("system.guidance.up=w", "unknown system.guidance.up 'w'"),
        ("system.guidance.min_step_percent=[0,0.02,0.9,100]", "0.9 is above max_step_percent"),
        ("system.optimizer.args.eps=-1", "Adam doesn't accept this: Invalid epsilon value"),
        ("system.optimizer.args.betas=[0.9]", "system.optimizer.args.betas: Adam doesn't accept"),
        ("system.optimizer.args.capturable=true", "Adam doesn't accept this: If capturable=True"),
        ("system.optimizer.name=Optimizer", "Optimizer doesn't accept this"),
        ("trainer.max_time=5", "trainer.max_time: expected a text such as '00:12:00:00'"),
        ("trainer.check_val_every_n_epoch=0", "trainer.check_val_every_n_epoch: expected 1"),
        ("trainer.precision=transformer-engine", "trainer: Requirement 'transformer_engine"),
        ("trainer.num_nodes=2", "trainer.num_nodes: expected 1 without a launcher of several"),
        ("data.eval_camera_distance=1e30", "data.eval_camera_distance: expected a number from"),
        ("trainer.limit_test_batches=0", "trainer.limit_test_batches: expected more than 0"),
        ("system.evaluation={size: 9999, views: 9999}", "pixels, twice take about 39.99 TB of"),
        ("data.train_views=1000000000000", "data.train_views: 1000000000000 views take about"),
        ("data.batch_size=[4096, 4096]", "2 entries need 1 resolution_milestones, the steps"),
        ("data={height: 9999, width: 9999, batch_size: 999}", "data.batch_size: 999 views of"),
        ("system.geometry.prior.num_points=999999999999", "999999999999 points take about"),
        ("system.geometry.grow.num_candidates=999999999999", "999999999999 candidates take about"),
        ("trainer.val_check_interval=0.5", "trainer.val_check_interval: expected a whole number"),
        ("trainer.strategy=ddp_spawn", "trainer.strategy 'ddp_spawn': choose from auto, ddp"),
        ("system.geometry_type=[a,b]", "system.geometry_type is ['a', 'b']; expected the name"),
        ("system.loss.lambda_sds=[1,2]", "system.loss.lambda_sds is [1, 2], of 2 elements"),
        ("system.loggers.wadb={}", "unknown key 'system.loggers.wadb': did you mean"),
        ("trainer.limit_val_batches=many", "limit_val_batches: expected a whole number or a num"),
        ("trainer.limit_train_batches=1", "expected no value, since views are drawn without end"),
        ("trainer.overfit_batches=2", "trainer.overfit_batches: expected no value, since views"),
        ("trainer.accelerator=cpu", "trainer.accelerator is set by --gpu"),
        ("checkpoint.every_n_epochs=1", "checkpoint: Combination of parameters"),
        ("checkpoint.filename='{step'", "checkpoint.filename: expected '}' before end of string"),
        ("checkpoint.filename=../x", "checkpoint.filename: expected a name of at most 200 bytes"),
        ("checkpoint.filename=/tmp/x", "checkpoint.filename: expected a name of at most 200"),
        (f"checkpoint.filename={300 * 'a'}", "checkpoint.filename: expected a name of at most 200"),
        ("checkpoint.dirpath=x", "checkpoint.dirpath is set by exp_root_dir"),
        ("viewer={prot: 80}", "unknown key 'viewer.prot': did you mean 'viewer.port'"),
        ("viewer={port: 0}", "viewer.port: expected a number from 1 to 65535, got 0"),
    ],
)
def test_a_wrong_value_is_refused_by_the_check(demo, override, message):
    name, _, value = override.partition("=")
    cfg = copy.deepcopy(demo)
    OmegaConf.update(cfg, name, yaml.safe_load(value), force_add=True)
    with pytest.raises(UserError, match=re.escape(message)):
        check_config(cfg)


def test_a_valid_configuration_passes_and_its_numbers_become_numbers(demo):
    cfg = copy.deepcopy(demo)
    cfg.system.loss |= {"lambda_sparsity": [0, 0.0, 1.0, 5], "lambda_other": 0}
    cfg.trainer |= {"limit_val_batches": 1, "limit_train_batches": 1.0, "overfit_batches": 0.0}
    cfg.trainer |= {"max_time": "00:01:00:00", "max_steps": "-1", "strategy": "ddp"}
    cfg.checkpoint.every_n_train_steps = 5
    check_config(cfg)
    cfg.trainer.strategy = None  # as old parsed.yaml have it
    cfg.system.exporter_type, cfg.system.exporter = "dummy-exporter", {}
    check_config(cfg)
    assert cfg.trainer.max_steps == -1 and cfg.trainer.strategy == "auto"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.camera_distance_range.0=4", "data.camera_distance_range is a list in one and a"),
        ("system.optimizer=[1]", "system.optimizer is a list in one and a section in another"),
        ("system.geometry.lr_means=1e39", "system.geometry.lr_means: expected a finite number"),
        ("system.loss.lambda_sds=[0,1,1e300,9]", "system.loss.lambda_sds[2]: expected a finite"),
        ("trainer=", "trainer is empty, which would remove its"),
        ("trainer.max_steps=-1", "checkpoint: Invalid value for every_n_train_steps=-1"),
        ("exp_root_dir=s3://a/b", "a single run writes to a folder, and only the farm to a URL"),
    ],
)
def test_a_wrong_text_is_refused_when_it_is_read(override, message):
    with pytest.raises(UserError, match=re.escape(message)):
        check_config(load_config(DEMO, cli_args=[*SMALL, override]))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("trainer.accumulate_grad_batches=2", "trainer: Automatic gradient accumulation"),
        ("exp_root_dir=" + 300 * "x", "can't be written: File name too long"),
        ("system.geometry.weights=last.ckpt", "expected <checkpoint>:<module>"),
    ],
)
def test_what_only_the_run_can_see_is_refused_before_any_work(launch_demo, override, message):
    assert_refused(*launch_demo(override), message)


BAD_VALUES = ([1, 2, 3, 4, 5, 6, 7], {"a": 1}, float("nan"), None, "abc", -1)


@pytest.mark.parametrize(
    "name",
    [n for n in host.names() if host.find(n).__module__.startswith("threestudio_gaussiandreamer")],
)
def test_no_option_of_any_part_ends_in_a_traceback(name):
    """Nor is a value that is neither number nor text accepted as one."""
    config = getattr(host.find(name), "Config", None)
    for option in dataclasses.fields(config) if config else ():
        for value in BAD_VALUES:
            try:
                check_part("part", name, {option.name: value})
            except UserError as error:
                # as it begins, or named: unknown key 'part.prior.a'
                begins = ("part.", "unknown part.", "unknown key 'part.")
                assert str(error).startswith(begins), error
            else:
                single = option.type in (int, float, bool, str)
                wrong = value is None or isinstance(value, (list, dict)) or value != value
                assert not (single and wrong), f"{name}.{option.name} takes {value!r}"


Uncallable = type("Uncallable", (BaseObject,), {})
NoForward = type("NoForward", (BaseModule,), {})
Unfinished = type("Unfinished", (BaseBackground,), {})


class NoArgument(BaseObject):
    def __call__(self): ...


class Threestudios(BaseObject):
    def __call__(self, rgb, prompt_utils, elevation, *, azimuth, **kwargs): ...


@pytest.mark.parametrize(
    ("kind", "part", "message"),
    [
        ("guidance", Uncallable, r"system.guidance_type: Uncallable has no __call__\(rgb, ...\)"),
        ("guidance", NoForward, r"system.guidance_type: NoForward has no forward\(rgb, ...\)"),
        ("guidance", NoArgument, r"called as __call__\(rgb, ...\): too many positional"),
        ("background", Unfinished, r"background_type: Unfinished has no forward\(dirs, ...\)"),
        ("prior", len, "prior_type: x is a builtin_function_or_method; register a class"),
    ],
)
def test_a_part_that_cannot_be_called_is_refused(kind, part, message):
    with pytest.raises(UserError, match=message):
        check_kind(f"system.{kind}_type", "x", part)
    check_kind("system.guidance_type", "threestudios", Threestudios)


def test_an_extension_that_can_not_be_loaded_is_one_message(folder, monkeypatch):
    def forbidden(path):
        raise PermissionError(13, "Permission denied")

    with pytest.raises(UserError, match="from the folder custom here, and there is none"):
        find_part("system.guidance_type", "nowhere-guidance")
    (folder / "custom/logging").mkdir(parents=True)
    (folder / "custom/logging/__init__.py").touch()
    with pytest.raises(UserError, match="custom/logging has the name of a module"):
        load_extensions()
    monkeypatch.setattr("pathlib.Path.is_file", forbidden)
    with pytest.raises(UserError, match="the extensions in custom can't be read: .*denied"):
        load_extensions()


def test_another_part_forgets_the_options_that_only_the_earlier_one_has():
    """So that it needs one override; misspelt options are still errors."""
    prior = "system.geometry.prior"
    other = [f"{prior}_type=random-prior", f"{prior}.size=0.5"]
    cfg = load_config(DEMO, cli_args=other)
    assert dict(cfg.system.geometry.prior) == {"num_points": 16000, "size": 0.5}
    check_config(cfg)
    cfg.system.geometry.prior.sise = 0.5
    with pytest.raises(UserError, match="did you mean 'system.geometry.prior.size'"):
        check_config(cfg)
    same = load_config(DEMO, cli_args=[f"{prior}_type=mesh-prior"])
    assert "path" in same.system.geometry.prior


def test_another_guidance_forgets_the_weights_of_losses_that_it_does_not_return():
    path = "system.geometry.prior.path=toy.glb"
    overrides = ["system.guidance_type=foo-guidance", "system.loss.lambda_foo=1", path]
    cfg = load_config(DEMO, cli_args=[*overrides, "system.loss.lambda_tv=2"])
    assert dict(cfg.system.loss) == {"lambda_foo": 1, "lambda_tv": 2}
    check_config(cfg)
    with pytest.raises(UserError, match="give its weight, for instance system.loss.lambda_foo=1"):
        check_config(load_config(DEMO, cli_args=[overrides[0], path]))


def test_a_weight_of_0_or_null_removes_that_of_an_earlier_file():
    check_config(load_config(DEMO, cli_args=["system.loss.lambda_other=null"]))
    with pytest.raises(UserError, match="leave it out: system.loss.lambda_other=0"):
        check_config(load_config(DEMO, cli_args=["system.loss.lambda_other=1"]))


class Undecorated(BaseObject):
    class Config(BaseObject.Config):
        color: float = 0.5


class PlainConfig(BaseObject):
    class Config:
        color = 0.5


class UntypedOption(BaseObject):
    @dataclass
    class Config(BaseObject.Config):
        SHARES = (0.25, 0.75)
        width: int = 3
        color = 0.5

        @staticmethod
        def check(cfg):
            """Has no type either."""


class InheritedConfig(FooGuidance):
    class Config(FooGuidance.Config):
        """Adds no option."""


def test_options_that_would_be_ignored_are_named():
    for part in (Undecorated, PlainConfig, UntypedOption):
        with pytest.raises(UserError, match="Config is no dataclass with typed .* color: float = "):
            require_dataclass(part)
    require_dataclass(InheritedConfig)


PERP_NEG = "system.prompt_processor.use_perp_neg=true"
LATENT = "system.guidance.space=latent"


def check(names, *overrides):
    paths = [DEMO.with_name(f"{name}.yaml") for name in names]
    given = ["system.prompt_processor.prompt=a fox"] if "demo" not in names else []
    check_config(load_config(*paths, cli_args=[*given, *overrides]))


MVDREAM = ("gaussiandreamer", "gaussiandreamer-mvdream")
PAPER = ("gaussiandreamer",)
SAME_TEXT = [PERP_NEG, "system.guidance.view_dependent_prompting=false"]
PLAIN = ["system.prompt_processor_type=plain-prompt-processor", "system.prompt_processor={}"]
WRONG = [
    (MVDREAM, ["data.n_view=2"], "data.n_view: the guidance sees 4 views"),
    (MVDREAM, [PERP_NEG], "this guidance has one prompt for all"),
    (PAPER, SAME_TEXT, "set system.guidance.view_dependent_prompting=true"),
    (PAPER, PLAIN, "needs one that encodes text"),
    (("toybox",), [PERP_NEG], "or system.guidance.view_contrast=0"),
    (("demo",), (LATENT, "data.height=250"), "pictures of 250x256 can't be pooled"),
    (("demo",), (LATENT, "data.width=[256,250]", "data.resolution_milestones=[9]"), "256x250"),
    (("demo",), (LATENT, "system.renderer.downsample=2", "data.height=280"), "of 140x128"),
    (("demo",), (LATENT, "system.guidance.image_size=64", "data.width=252"), "of 64x63"),
    (("demo",), ("system.guidance.mode=view-agnostic", "data.height=4096"), "needs .* GiB"),
    (("toybox",), [PERP_NEG, "system.guidance.view_contrast=0"], None),
    (("demo",), [LATENT, "data.height=512", "system.renderer.downsample=2"], None),
    (("demo",), ["data.height=250"], None),
    (MVDREAM, [], None),
]


@pytest.mark.parametrize(("names", "overrides", "message"), WRONG)
def test_options_of_different_sections(names, overrides, message):
    if message is None:
        return check(names, *overrides)
    with pytest.raises(UserError, match=message):
        check(names, *overrides)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["batch_size=4"], "data.batch_size is 4, no multiple of the 3 processes"),
        (["batch_size=[6,2]", "resolution_milestones=[9]"], "batch_size is 2, fewer than the 3"),
    ],
)
def test_processes_that_cant_share_the_views_are_found_before_they_start(overrides, message):
    data = [f"data.{override}" for override in overrides]
    cfg = load_config(DEMO, cli_args=[*data, "trainer.devices=3"])
    with pytest.raises(UserError, match=message):
        config_check.check_shared_views(cfg)
    cfg.n_gpus = 2
    config_check.check_shared_views(cfg)
