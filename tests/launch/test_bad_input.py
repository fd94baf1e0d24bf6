"""Wrong values of options: one message, before any work."""

import copy
import dataclasses
import re

import pytest
import yaml
from omegaconf import OmegaConf

from tests.launch.bad_input_cases import DEMO, SMALL, assert_refused
from threestudio_gaussiandreamer import host, register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config, check_part
from threestudio_gaussiandreamer.launch.parts import check_kind

register_parts()


@pytest.fixture(scope="module")
def demo():
    return load_config(DEMO, cli_args=SMALL)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("system.loss.lamda_sds=1", "weights of losses are called lambda_<loss>"),
        ("system.exporter.options.ply.pad_sh_degre=3", "did you mean 'options.ply.pad_sh_degree'"),
        (
            "system.exporter.options.ply.pad_sh_degree=9",
            "pad_sh_degree: expected a number from 0 to 3",
        ),
        ("system.exporter.options.ply.save_name=../x.ply", "save_name: expected the name of a"),
        ("system.exporter.options.ply=3", "options.ply: expected keys and values"),
        ("system.loggers.wandb=true", "system.loggers.wandb is True; expected keys and values"),
        ("system.material_type=''", "system.material_type is empty: name a registered part, such"),
        ("system.guidance_type=exact-scores", "system.guidance_type: unknown part 'exact-scores'"),
        ("system.renderer_type=no-material", "needs gaussiandreamer-splatting, or a class"),
        ("system.material_type=gaussiandreamer-cloud", "a part of the kind geometry; expected one"),
        ("system.background_type=ply-exporter", "a part of the kind exporter; expected one of the"),
        ("data_type=mesh-prior", "data_type is 'mesh-prior', a part of the kind prior; expected"),
        ("data.rays=-1", "data.rays: expected true or false, got -1"),
        ("system.background.color=[1]", "system.background.color: expected a list of 3"),
        ("system.background.color=[.nan,0,0]", "system.background.color[0]: expected a finite"),
        ("system.geometry.grow.radius=[1]", "system.geometry.grow.radius: expected a number, got"),
        ("system.geometry.densify.max_scale=.inf", "system.geometry.densify.max_scale: expected a"),
        ("system.geometry.prior.color=3", "color: expected null, 'grey', 'random' or [red, green,"),
        ("data.camera_perturb=-1", "data.camera_perturb: expected a number from 0 to 1e+06"),
        ("data.eval_camera_distance=0", "data.eval_camera_distance: expected a number from 1e-06"),
        ("data.elevation_range=[-100,0]", "data.elevation_range: expected [low, high], degrees"),
        ("data.resolution_milestones=[2,1]", "data.resolution_milestones: expected increasing"),
        ("data.resolution_milestones=[5]", "data.resolution_milestones: give height, width or"),
        ("system.geometry.grow.max_points=-1", "system.geometry.grow.max_points: expected 0 or"),
        ("system.geometry.lr_means=-1", "system.geometry.lr_means: expected values of 0 or more"),
        ("system.geometry.densify.min_opacity=1", "system.geometry.densify.min_opacity"),
        ("system.geometry.prior.up=+w", "unknown up axis '+w'"),
        ("system.geometry.prior.scale=0", "system.geometry.prior.scale: expected a number above 0"),
        ("system.guidance.up=w", "unknown system.guidance.up 'w'"),
        ("system.guidance.front=x", "unknown system.guidance.front 'x': did you mean"),
        ("system.guidance.supersample=0", "system.guidance.supersample: expected a number"),
        ("system.renderer.radius=0", "system.renderer.radius: expected a number above 0"),
        ("system.material.color_activation=relu", "unknown system.material.color_activation"),
        ("system.guidance.min_step_percent=[0,0.02,0.9,100]", "0.9 is above max_step_percent"),
        ("system.optimizer.args.eps=-1", "Adam doesn't accept this: Invalid epsilon value"),
        ("system.optimizer.args.betas=[0.9]", "system.optimizer.args.betas: Adam doesn't accept"),
        ("system.optimizer.args={fused: true, foreach: true}", "Adam doesn't accept this: `fused`"),
        ("system.optimizer.args.capturable=true", "Adam doesn't accept this: If capturable=True"),
        ("system.optimizer.args=3", "system.optimizer.args: expected keys and values"),
        ("system.optimizer.name=Optimizer", "Optimizer doesn't accept this"),
        ("trainer.max_time=5", "trainer.max_time: expected a text such as '00:12:00:00'"),
        ("trainer.check_val_every_n_epoch=0", "trainer.check_val_every_n_epoch: expected 1"),
        ("trainer.precision=transformer-engine", "trainer: Requirement 'transformer_engine"),
        ("trainer.num_nodes=2", "trainer.num_nodes: expected 1 without a launcher of several"),
        ("trainer.limit_val_batches=" + 400 * "9", "trainer.limit_val_batches: expected a whole"),
        ("data.eval_camera_distance=1e30", "data.eval_camera_distance: expected a number from"),
        ("system.guidance.guidance_scale=1e38", "system.guidance.guidance_scale: expected a"),
        ("trainer.limit_test_batches=0", "trainer.limit_test_batches: expected more than 0"),
        ("system.evaluation.size=100000", "system.evaluation.size: expected a number from 6 to"),
        ("system.evaluation={size: 9999, views: 9999}", "pixels, twice take about 39.99 TB of"),
        ("data.train_views=1000000000000", "data.train_views: 1000000000000 views take about"),
        ("data.batch_size=[4096, 4096]", "2 entries need 1 resolution_milestones, the steps"),
        ("data.eval_height=100000", "data.eval_height: expected a number from 1 to 16384"),
        ("data={height: 9999, width: 9999, batch_size: 999}", "data.batch_size: 999 views of"),
        ("system.geometry.prior.num_points=999999999999", "999999999999 points take about"),
        ("system.geometry.grow.num_candidates=999999999999", "999999999999 candidates take about"),
        ("trainer.val_check_interval=0", "trainer.val_check_interval: expected a whole number of"),
        ("trainer.val_check_interval=0.5", "trainer.val_check_interval: expected a whole number"),
        ("trainer.log_every_n_steps=-1", "trainer.log_every_n_steps: expected 0 or more"),
        (
            "trainer.strategy=ddp_spawn",
            "unknown trainer.strategy 'ddp_spawn': choose from auto, ddp",
        ),
        ("trainer.enable_checkpointing=false", "trainer.enable_checkpointing is set by the"),
        ("checkpoint.filename=../../x", "checkpoint.filename is '../../x'"),
        ("checkpoint.filename='{step}/../../../x'", "below the folder of the checkpoints"),
        ('checkpoint.filename="a\\0b"', "of names of at most 200 bytes"),
        (f"checkpoint.filename={300 * 'x'}", "of names of at most 200 bytes"),
        ("checkpoint.filename='{step'", "expected a format such as '{epoch}-{step}'"),
        ("checkpoint.filename='{step[0]}'", "expected a format such as '{epoch}-{step}'"),
    ],
)
def test_a_wrong_value_is_refused_by_the_check(demo, override, message):
    name, _, value = override.partition("=")
    cfg = copy.deepcopy(demo)
    OmegaConf.update(cfg, name, yaml.safe_load(value))
    with pytest.raises(UserError, match=re.escape(message)):
        check_config(cfg)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.camera_distance_range.0=4", "data.camera_distance_range is a list in one and a"),
        ("system.optimizer=[1]", "system.optimizer is a list in one and a section in another"),
        ("system.geometry.lr_means=1e39", "system.geometry.lr_means: expected a finite number"),
        ("system.loss.lambda_sds=[0,1,1e300,9]", "system.loss.lambda_sds[2]: expected a finite"),
        ("trainer=", "trainer is empty, which would remove its"),
        ("exp_root_dir=a\0b", "no folder's name has a NUL"),
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
    [
        name
        for name in host.names()
        if host.find(name).__module__.startswith("threestudio_gaussiandreamer")
    ],
)
def test_no_option_of_any_part_ends_in_a_traceback(name):
    """The check accepts or names any value of any option; a value that is neither number nor text
    is never accepted as one.
    """
    config = getattr(host.find(name), "Config", None)
    for field in dataclasses.fields(config) if config else ():
        for value in BAD_VALUES:
            try:
                check_part("part", name, {field.name: value})
            except UserError as error:
                # as it begins, or named: unknown key 'part.prior.a'
                assert str(error).startswith(("part.", "unknown part.", "unknown key 'part.")), (
                    error
                )
            else:
                single = field.type in (int, float, bool, str)
                assert not (single and (value is None or isinstance(value, (list, dict)))), (
                    f"{name}.{field.name} takes {value!r}"
                )
                assert not (field.type is float and value != value), (
                    f"{name}.{field.name} takes NaN"
                )


def test_a_guidance_that_takes_no_render_is_refused():
    class Uncallable(host.BaseObject):
        pass

    class NoArgument(host.BaseObject):
        def __call__(self):
            return {}

    class Threestudios(host.BaseObject):
        def __call__(self, rgb, prompt_utils, elevation, *, azimuth, **kwargs):
            return {}

    with pytest.raises(UserError, match=r"system.guidance_type: .* has no __call__\(rgb, ...\)"):
        check_kind("system.guidance_type", "uncallable", Uncallable)
    with pytest.raises(UserError, match=r"called as __call__\(rgb, ...\): too many positional"):
        check_kind("system.guidance_type", "no-argument", NoArgument)
    check_kind("system.guidance_type", "threestudios", Threestudios)
