"""Misspelt keys and broken extensions are named."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.launch.config_cases import load
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.methods import require_dataclass
from threestudio_gaussiandreamer.host import BaseBackground, BaseObject, find, register
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import (
    check_config,
    check_part,
    check_shared_views,
)
from threestudio_gaussiandreamer.launch.parts import check_kind, find_part, load_extensions

register_parts()
CONFIGS = Path(__file__).parents[2] / "configs"
DEMO = CONFIGS / "demo.yaml"


@register("optionless-part")
class OptionlessPart:
    @dataclass
    class Config:
        pass


@register("foo-guidance")
class FooGuidance(BaseObject):
    LOSSES = ("foo",)

    def __call__(self, rgb):
        return {"loss_foo": rgb.sum()}


@register("table-part")
class TablePart(BaseObject):
    @dataclass
    class Config(BaseObject.Config):
        weights: dict = field(
            default_factory=lambda: {"depth": 0.1, "on": True, "kind": {"name": "l1"}}
        )
        free: dict = field(default_factory=dict)


# -- the check -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"depht": 1}, r"unknown key 'part.weights.depht': did you mean 'part.weights.depth'\?"),
        ({"kind": {"nam": "l2"}}, "unknown key 'part.weights.kind.nam'"),
        ({"depth": "x"}, "part.weights.depth: expected a number, got 'x'"),
        ({"on": 1}, "part.weights.on: expected true or false, got 1"),
        ({"kind": 1}, "part.weights.kind is 1; expected keys and values"),
    ],
)
def test_a_dictionary_of_a_part_is_checked_by_its_default(weights, message):
    with pytest.raises(UserError, match=message):
        check_part("part", "table-part", {"weights": weights})
    valid = {"depth": [0, 1, 0.1, 9], "on": False, "kind": {"name": "l2"}}
    check_part("part", "table-part", {"weights": valid, "free": {"anything": "x"}})


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("system.geometry.size=big", "system.geometry.size: expected a whole number, got 'big'"),
        ("system.geometry.prior.count=0", "prior.count: expected at least 1, got 0"),
        ("system.geometry_type=tiny-geomerty", "system.geometry_type: unknown part"),
        ("system_type=tiny-sistem", "unknown part 'tiny-sistem': did you mean 'tiny-system'"),
        ("data_type=", "data_type"),
        ("system.geometry_type=[a,b]", "system.geometry_type is ['a', 'b']; expected the name"),
        ("data.veiws=3", "unknown key 'data.veiws'"),
        ("system.geometry=3", "system.geometry"),
        ("system.loss.sds=1", "weights of losses are called lambda_<loss>"),
        ("system.loss.lambda_sparsty=1", "did you mean 'system.loss.lambda_sparsity'"),
        ("system.loss.lambda_fit=[1,2]", "system.loss.lambda_fit has 2 elements"),
        ("system.loggers.wadb.enable=true", "unknown key 'system.loggers.wadb'"),
        ("system.loggers.wandb.enabled=true", "unknown key 'system.loggers.wandb.enabled'"),
        ("trainer.max_steps=many", "trainer.max_steps: expected a whole number, got 'many'"),
        ("trainer.max_steps=2.5", "trainer.max_steps: expected a whole number, got 2.5"),
        ("trainer.limit_val_batches=many", "limit_val_batches: expected a whole number or a num"),
        ("trainer.precision=17", "trainer: Precision 17 is invalid"),
        ("trainer.limit_train_batches=0", "set trainer.max_steps for a short run, got 0"),
        ("trainer.limit_train_batches=1", "expected no value, since views are drawn without end"),
        ("trainer.overfit_batches=2", "trainer.overfit_batches: expected no value, since views"),
        ("trainer.accelerator=cpu", "trainer.accelerator is set by --gpu"),
        ("trainer.logger=false", "trainer.logger is set by the launcher"),
        ("checkpoint.every_n_steps=3", "unknown key 'checkpoint.every_n_steps'"),
        ("checkpoint.every_n_epochs=1", "checkpoint: Combination of parameters"),
        ("checkpoint.dirpath=x", "checkpoint.dirpath is set by exp_root_dir"),
        ("viewer.prot=80", "viewer.prot"),
        ("viewer.port=0", "viewer.port"),
        ("viewer.port=http", "viewer.port"),
        ("viewer.updates_per_second=0", "viewer.updates_per_second"),
        ("viewer=on", "viewer"),
    ],
)
def test_a_mistake_is_named_by_its_path(folder, override, message):
    with pytest.raises(UserError, match=re.escape(message)):
        check_config(load(override))


def test_a_valid_configuration_passes(folder):
    check_config(
        load(
            "system.loss.lambda_sparsity=[0,0.0,1.0,5]",
            "trainer.limit_val_batches=1",
            "trainer.limit_train_batches=1.0",
            "trainer.overfit_batches=0.0",
            "system.loss.lambda_other=0",
            "system.loss.lambda_another=null",
            "trainer.max_time=00:01:00:00",
        )
    )
    cfg = load("trainer.max_steps='12'", "trainer.strategy=ddp")
    check_config(cfg)
    assert cfg.trainer.max_steps == 12
    check_config(load_config("tiny.yaml", cli_args=["system.exporter_type=dummy-exporter"]))


def test_a_key_of_a_part_without_options_is_named():
    with pytest.raises(UserError, match=r"unknown key 'x.foo': there are none"):
        check_part("x", "optionless-part", {"foo": 1})


# -- extensions ------------------------------------------------------------------------------------


def test_extensions_of_both_kinds_are_loaded_and_others_left_out(folder):
    part = (
        "from threestudio_gaussiandreamer.host import BaseObject, "
        "register\n@register('{0}')\nclass Part(BaseObject): pass\n"
    )
    (folder / "custom" / "my-package").mkdir(parents=True)
    (folder / "custom" / "my-package" / "__init__.py").write_text("from . import inner")
    (folder / "custom" / "my-package" / "inner.py").write_text(part.format("package-prior"))
    (folder / "custom" / "single_prior.py").write_text(part.format("single-prior"))
    for name in ("old_disabled.py", ".hidden.py", "notes.txt"):
        (folder / "custom" / name).write_text("raise RuntimeError")
    for name in ("folder_disabled", "no_init", "__pycache__"):
        (folder / "custom" / name).mkdir()
    assert load_extensions() == ["my-package", "custom/single_prior"]
    assert find("package-prior").__module__ == "my-package.inner"
    assert find("single-prior").__module__ == "custom/single_prior"
    # a second run in this process doesn't execute them again
    assert load_extensions() == ["my-package", "custom/single_prior"] and find("single-prior")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = '\0'", "null bytes"),
        ("def f():\n    raise KeyError('a')\n\nf()\n", "custom/broken.py:2: KeyError: 'a'"),
    ],
)
def test_a_broken_extension_is_an_error_with_file_line_and_cause(folder, source, message):
    (folder / "custom").mkdir()
    (folder / "custom" / "broken.py").write_text(source)
    said = f"the extension custom/broken.py can't be imported: .*{message}"
    with pytest.raises(UserError, match=said):
        load_extensions()


def test_an_extension_with_the_name_of_a_module_is_refused(folder):
    (folder / "custom/logging").mkdir(parents=True)
    (folder / "custom/logging/__init__.py").touch()
    with pytest.raises(UserError, match="custom/logging has the name of a module"):
        load_extensions()


def test_an_unknown_part_says_where_own_parts_are_looked_for(folder):
    with pytest.raises(UserError, match="the folder custom in the working folder, which has none"):
        find_part("system.guidance_type", "nowhere-guidance")


def test_another_part_forgets_the_options_that_only_the_earlier_one_has():
    """Another prior or guidance needs one override: options of the new part are kept, misspelt ones
    are still errors.
    """
    cfg = load_config(
        DEMO, cli_args=["system.geometry.prior_type=random-prior", "system.geometry.prior.size=0.5"]
    )
    assert dict(cfg.system.geometry.prior) == {"num_points": 16000, "size": 0.5}
    check_config(cfg)
    wrong = load_config(
        DEMO, cli_args=["system.geometry.prior_type=random-prior", "system.geometry.prior.sise=0.5"]
    )
    with pytest.raises(UserError, match="system.geometry.prior.size"):
        check_config(wrong)
    same = load_config(DEMO, cli_args=["system.geometry.prior_type=mesh-prior"])
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
    for value in ("0", "0.0", "null"):
        check_config(load_config(DEMO, cli_args=[f"system.loss.lambda_other={value}"]))
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


@pytest.mark.parametrize("part", [Undecorated, PlainConfig, UntypedOption])
def test_options_that_would_be_ignored_are_named(part):
    with pytest.raises(UserError, match="Config is no dataclass with typed .* color: float = "):
        require_dataclass(part)
    require_dataclass(InheritedConfig)


def test_an_endless_run_needs_its_own_number_for_checkpoints(folder):
    with pytest.raises(UserError, match="checkpoint.every_n_train_steps is -1, as trainer.max_st"):
        check_config(load("trainer.max_steps=-1"))
    check_config(load("trainer.max_steps=-1", "checkpoint.every_n_train_steps=5"))


def test_a_part_that_is_no_class_is_refused():
    with pytest.raises(UserError, match="prior_type: f is a function; register a class"):
        check_kind("system.geometry.prior_type", "f", lambda cfg: None)


def test_a_background_without_forward_is_refused():
    class Unfinished(BaseBackground):
        pass

    with pytest.raises(UserError, match=r"background_type: Unfinished has no forward\(dirs, ...\)"):
        check_kind("system.background_type", "unfinished", Unfinished)


# -- options of different sections -----------------------------------------------------------------

PERP_NEG = "system.prompt_processor.use_perp_neg=true"
LATENT = "system.guidance.space=latent"


def check(names, *overrides):
    paths = [CONFIGS / f"{name}.yaml" for name in names]
    given = ["system.prompt_processor.prompt=a fox"] if "demo" not in names else []
    check_config(load_config(*paths, cli_args=[*given, *overrides]))


MVDREAM = ("gaussiandreamer", "gaussiandreamer-mvdream")
WRONG = [
    (MVDREAM, ["data.n_view=2"], "data.n_view: the guidance sees 4 views"),
    (MVDREAM, [PERP_NEG], "this guidance has one prompt for all"),
    (
        ("gaussiandreamer",),
        [PERP_NEG, "system.guidance.view_dependent_prompting=false"],
        "set system.guidance.view_dependent_prompting=true",
    ),
    (("toybox",), [PERP_NEG], "or system.guidance.view_contrast=0"),
    (
        ("gaussiandreamer",),
        ["system.prompt_processor_type=plain-prompt-processor", "system.prompt_processor={}"],
        "needs a prompt processor that encodes text",
    ),
    (("demo",), (LATENT, "data.height=250"), "pictures of 250x256 can't be pooled"),
    (("demo",), (LATENT, "data.width=[256,250]", "data.resolution_milestones=[9]"), "256x250"),
    (("demo",), (LATENT, "system.renderer.downsample=2", "data.height=280"), "of 140x128"),
    (("demo",), (LATENT, "system.guidance.image_size=64", "data.width=252"), "of 64x63"),
    (("demo",), ("system.guidance.mode=view-agnostic", "data.height=4096"), "needs .* GiB"),
]


@pytest.mark.parametrize(("names", "overrides", "message"), WRONG)
def test_contradictions_are_named(names, overrides, message):
    with pytest.raises(UserError, match=message):
        check(names, *overrides)


@pytest.mark.parametrize(
    ("names", "overrides"),
    [
        (("toybox",), [PERP_NEG, "system.guidance.view_contrast=0"]),
        (("demo",), [LATENT, "data.height=512", "system.renderer.downsample=2"]),
        (("demo",), ["data.height=250"]),
        (MVDREAM, []),
    ],
)
def test_valid_combinations_pass(names, overrides):
    check(names, *overrides)


@pytest.mark.parametrize(
    ("batch", "processes", "message"),
    [
        ("4", 3, "data.batch_size is 4, no multiple of the 3 processes"),
        ("[8,2]", 4, "data.batch_size is 2, fewer than the 4 processes"),
    ],
)
def test_processes_that_cant_share_the_views_are_found_before_they_start(batch, processes, message):
    overrides = [f"data.batch_size={batch}", f"trainer.devices={processes}"]
    if "[" in batch:
        overrides.append("data.resolution_milestones=[9]")
    cfg = load_config(DEMO, cli_args=overrides)
    with pytest.raises(UserError, match=message):
        check_shared_views(cfg)
    cfg.n_gpus = 2
    check_shared_views(cfg)
