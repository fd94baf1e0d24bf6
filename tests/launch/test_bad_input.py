"""Wrong input as a stranger gives it: one message, exit code 2, before any long work, nothing left
behind, no traceback.
"""

import dataclasses
import json
import os
import shutil
import signal
from pathlib import Path

import pytest
import torch

from tests.helpers.checkpoints import whole_checkpoint
from threestudio_gaussiandreamer import host, register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.option_types import check_types
from threestudio_gaussiandreamer.launch import experiment, folder_lock
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_part
from threestudio_gaussiandreamer.training import held_out as evaluate
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

register_parts()
DEMO = Path(__file__).parents[2] / "configs" / "demo.yaml"
SMALL = [
    "data.width=16", "data.height=16", "data.eval_width=16", "data.eval_height=16",
    "data.n_test_views=2", "data.train_views=4", "system.geometry.prior.num_points=80",
    "system.geometry.prior.color_smoothing=0", "system.geometry.grow.num_candidates=200",
    "system.evaluation.size=16", "system.evaluation.views=2", "trainer.enable_progress_bar=false",
    "trainer.max_steps=2", "use_timestamp=false", "tag=t",
]  # fmt: skip
TRIAL = Path("outputs/demo/t")


@pytest.fixture
def launch(tmp_path, monkeypatch, capsys):
    """``launch(overrides...)`` trains a tiny demo in an empty folder; returns (exit code,
    stderr).
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")

    def run(*overrides: str, stage: str = "--train", config: str = str(DEMO)) -> tuple[int, str]:
        code = experiment.main(["--config", config, stage, "--gpu", "cpu", *SMALL, *overrides])
        return code, capsys.readouterr().err

    return run


def assert_refused(code: int, err: str, message: str) -> None:
    """One message, no traceback, nothing written, and the prior hasn't run."""
    assert code == 2 and "Traceback" not in err and not Path("outputs").exists(), err
    assert message in err and sum(line.startswith("error: ") for line in err.splitlines()) == 1
    assert "the cloud starts" not in err


# -- values ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "message"),
    [
        # keys
        ("system.geometry.grow.radus=1", "did you mean 'system.geometry.grow.radius'"),
        ("system.geometry.densify.evry=1", "did you mean 'system.geometry.densify.every'"),
        ("system.evaluation.vews=3", "did you mean 'system.evaluation.views'"),
        ("checkpoint.save_lst=true", "did you mean 'checkpoint.save_last'"),
        ("system.loss.lambda_sdss=1", "did you mean 'lambda_sds'"),
        ("system.loss.lamda_sds=1", "weights of losses are called lambda_<loss>"),
        ("system.exporter.formats=[plly]", "did you mean 'ply'"),
        ("system.exporter.options.ply.pad_sh_degre=3", "did you mean 'pad_sh_degree'"),
        (
            "system.exporter.options.ply.pad_sh_degree=9",
            "system.exporter.options.ply.pad_sh_degree: expected a number from 0 to 3",
        ),
        (
            "system.exporter.options.ply.save_name=../x.ply",
            "save_name: expected the name of a file",
        ),
        ("system.exporter.options.ply=3", "options.ply: expected keys and values"),
        ("system.loggers.wandb=true", "system.loggers.wandb is True; expected keys and values"),
        (
            "data.camera_distance_range.0=4",
            "data.camera_distance_range is a list in one and a section in another",
        ),
        # names
        ("system.geometry.prior_type=msh-prior", "did you mean 'mesh-prior'"),
        (
            "system.material_type=''",
            "system.material_type is empty: name a registered part, such as 'no-material'",
        ),
        ("system.guidance_type=''", "system.guidance_type is empty"),
        # a registered part of another kind
        (
            "system.geometry.prior_type=ply-exporter",
            "system.geometry.prior_type is 'ply-exporter', a part of the kind exporter; "
            "expected one of the kind prior",
        ),
        (
            "system.renderer_type=no-material",
            "a part of the kind material; expected one of the kind renderer",
        ),
        (
            "system.material_type=gaussiandreamer-cloud",
            "a part of the kind geometry; expected one of the kind material",
        ),
        (
            "system.background_type=ply-exporter",
            "a part of the kind exporter; expected one of the kind background",
        ),
        (
            "data_type=mesh-prior",
            "data_type is 'mesh-prior', a part of the kind prior; expected one of the kind data",
        ),
        # kinds and lengths
        ("data.elevation_range=[1]", "data.elevation_range: expected a list of 2, got [1]"),
        ("data.n_test_views=[1]", "data.n_test_views: expected a whole number, got [1]"),
        ("data.rays=-1", "data.rays: expected true or false, got -1"),
        ("system.background.color=[1]", "system.background.color: expected a list of 3"),
        (
            "system.background.color=[.nan,0,0]",
            "system.background.color[0]: expected a finite number",
        ),
        (
            "system.geometry.grow.radius=[1]",
            "system.geometry.grow.radius: expected a number, got [1]",
        ),
        (
            "system.geometry.densify.max_scale=.inf",
            "system.geometry.densify.max_scale: expected a finite number",
        ),
        (
            "system.geometry.prior.color=3",
            "color: expected null, 'grey', 'random' or [red, green, blue]",
        ),
        ("system.optimizer=[1]", "system.optimizer is a list in one and a section in another"),
        # ranges
        ("data.camera_perturb=-1", "data.camera_perturb: expected a number from 0 to 1e+06"),
        ("data.eval_camera_distance=0", "data.eval_camera_distance: expected a number from 1e-06"),
        (
            "data.eval_fovy_deg=180",
            "data.eval_fovy_deg: expected a number from 0.001 to 179.999 (degrees)",
        ),
        (
            "data.elevation_range=[-100,0]",
            "data.elevation_range: expected [low, high], degrees from -90 to 90",
        ),
        (
            "data.resolution_milestones=[2,1]",
            "data.resolution_milestones: expected increasing steps",
        ),
        (
            "data.resolution_milestones=[5]",
            "data.resolution_milestones: give height, width or batch_size 2 entries",
        ),
        (
            "system.geometry.grow.max_points=-1",
            "system.geometry.grow.max_points: expected 0 or more",
        ),
        ("system.geometry.lr_means=-1", "system.geometry.lr_means: expected values of 0 or more"),
        (
            "system.geometry.densify={enabled: true, start: 9, stop: 9}",
            "densify.stop: expected more than start",
        ),
        ("system.geometry.densify.min_opacity=1", "system.geometry.densify.min_opacity"),
        (
            "system.geometry.max_gaussians=1",
            "error: system.geometry.max_gaussians: expected min_gaussians (64) or more",
        ),
        ("system.geometry.prior.up=+w", "unknown up axis '+w'"),
        ("system.geometry.prior.scale=0", "system.geometry.prior.scale: expected a number above 0"),
        ("system.guidance.up=w", "unknown system.guidance.up 'w'"),
        ("system.guidance.front=x", "unknown system.guidance.front 'x': did you mean"),
        ("system.guidance.scale=0", "system.guidance.scale: expected a number above 0"),
        ("system.renderer.eps2d=-1", "system.renderer.eps2d: expected 0 or more"),
        ("system.renderer.radius=0", "system.renderer.radius: expected a number above 0"),
        (
            "system.material.color_activation=relu",
            "unknown system.material.color_activation 'relu'",
        ),
        (
            "system.guidance.min_step_percent=[0,0.02,0.9,100]",
            "system.guidance.min_step_percent: 0.9 is above max_step_percent",
        ),
        (
            "system.optimizer.args.bets=[0.9,0.9]",
            "Adam doesn't accept this: unknown argument 'bets': did you mean 'betas'?",
        ),
        ("system.optimizer.args.eps=-1", "Adam doesn't accept this: Invalid epsilon value"),
        ("system.optimizer.args=3", "system.optimizer.args: expected keys and values"),
        ("system.optimizer.name=Optimizer", "Optimizer doesn't accept this"),
        ("trainer.max_steps=-5", "trainer.max_steps: expected -1 or more"),
        ("trainer.max_time=5", "trainer.max_time: expected a text such as '00:12:00:00'"),
        ("trainer.check_val_every_n_epoch=0", "trainer.check_val_every_n_epoch: expected 1"),
        ("trainer.precision=transformer-engine", "trainer: Requirement 'transformer_engine"),
        ("trainer.strategy=ddp_spawn", "trainer.strategy: ddp_spawn can't start processes"),
        ("trainer.num_nodes=2", "trainer.num_nodes: expected 1, got 2"),
        # numbers that nothing can hold
        ("seed=" + 400 * "9", "seed: expected a whole number of at most 64 bits"),
        ("seed=" + 5000 * "9", "the value of seed isn't valid YAML: Exceeds the limit"),
        ("data.width=" + 400 * "9", "data.width: expected a whole number of at most 64 bits"),
        ("trainer.limit_val_batches=" + 400 * "9", "trainer.limit_val_batches: expected a whole"),
        ("system.geometry.lr_means=1e39", "system.geometry.lr_means: expected a finite number"),
        ("data.eval_camera_distance=1e30", "data.eval_camera_distance: expected a number from"),
        ("system.guidance.guidance_scale=1e38", "system.guidance.guidance_scale: expected a"),
        ("system.loss.lambda_sds=[0,1,1e300,9]", "system.loss.lambda_sds[2]: expected a finite"),
        ("system.evaluation.size=100000", "system.evaluation.size: expected a number from 1 to"),
        (
            "system.evaluation={size: 9999, views: 9999}",
            "pixels, twice take about 39.99 TB of memory",
        ),
        ("data.train_views=1000000000000", "data.train_views: 1000000000000 views take about"),
        ("data.batch_size=[4096, 4096]", "data.batch_size: 2 entries need 1 resolution_milestones"),
        ("data.eval_height=100000", "data.eval_height: expected a number from 1 to 16384"),
        ("data={height: 9999, width: 9999, batch_size: 999}", "data.batch_size: 999 views of"),
        ("system.geometry.prior.num_points=999999999999", "999999999999 points take about"),
        (
            "system.geometry.grow.num_candidates=999999999999",
            "system.geometry.grow.num_candidates: 999999999999 candidates take about",
        ),
        (
            "trainer.val_check_interval=0",
            "trainer.val_check_interval: expected a number of steps above 0",
        ),
        ("trainer.log_every_n_steps=-1", "trainer.log_every_n_steps: expected 0 or more"),
        (
            "trainer.accumulate_grad_batches=2",
            "trainer: Automatic gradient accumulation is not supported",
        ),
        ("trainer.strategy=foo", "trainer: You selected an invalid strategy name"),
        (
            "trainer.enable_checkpointing=false",
            "trainer.enable_checkpointing is set by the launcher",
        ),
        ("checkpoint.filename=../../x", "checkpoint.filename is '../../x'"),
        # folders and texts
        ("exp_root_dir=a\0b", "no folder's name has a NUL"),
        ("exp_root_dir=" + 300 * "x", "can't be written: File name too long"),
        ("system.prompt_processor.prompt=???", "'???' can't be a text"),
        ("system.geometry.weights=last.ckpt", "expected <checkpoint>:<module>"),
    ],
)
def test_a_wrong_value_is_refused_before_any_work(launch, override, message):
    assert_refused(*launch(override), message)


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
    """Whatever is written for an option, the check takes it or names it; what is no number or text
    is never taken for one.
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


@dataclasses.dataclass
class Inner:
    size: int = 1


@dataclasses.dataclass
class Outer:
    maybe: float | None = None
    names: list[str] = dataclasses.field(default_factory=list)
    pair: tuple[float, float] = (0.0, 1.0)
    inner: Inner = dataclasses.field(default_factory=Inner)
    whatever: object = None


def test_types_that_fit_are_taken():
    check_types(
        Outer,
        {
            "maybe": None,
            "names": ["a"],
            "pair": [1, 2],
            "inner": {"size": 2},
            "whatever": [1],
            "unknown": 3,
        },
    )
    pairs = ({"pair": [1]}, {"pair": [1, float("inf")]})
    for wrong in (
        {"maybe": [1]},
        {"names": "a"},
        {"names": [["a"]]},
        *pairs,
        {"inner": {"size": [1]}},
        {"inner": 3},
    ):
        with pytest.raises(UserError):
            check_types(Outer, wrong)


# -- files -----------------------------------------------------------------------------------------

PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty "
    b"float z\nend_header\n"
)
FILES = {
    "empty.glb": b"",
    "text.glb": b"hello there, this is no mesh",
    "empty.obj": b"# nothing\n",
    "nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "flat.obj": b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n",
    "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "mesh.yaml": b"a: 1\n",
}


@pytest.mark.parametrize("name", ["missing.glb", "", *FILES])
def test_a_mesh_that_is_none_is_refused(launch, name):
    if name in FILES:
        Path(name).write_bytes(FILES[name])
    code, err = launch(f"system.guidance.mesh={name}")
    assert_refused(code, err, name or "path")


@pytest.mark.parametrize(
    "prior", ["gaussians-prior", "point-cloud-prior", "mesh-prior", "body-prior"]
)
@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"hello",
        b"ply\nformat asc",
        PLY + b"nan nan nan\n",
        PLY + b"a b c\n",
        PLY.replace(b" 1\n", b" 99999999999\n"),
    ],
)
def test_a_file_that_no_prior_can_read_is_refused(tmp_path, prior, content):
    path = tmp_path / "start.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match="start.ply|PointCloudPrior"):
        host.find(prior)({"path": str(path)})("a fox")


def checkpoint(**changes: object) -> dict:
    lightnings = {"pytorch-lightning_version": "2.0.0", "loops": {}, "optimizer_states": []}
    return {"state_dict": {}, "epoch": 0, "global_step": 1, **lightnings, **changes}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (checkpoint(state_dict=[1]), "its state_dict is of type list"),
        (checkpoint(global_step=None), "its global_step is of type NoneType"),
        (
            {k: v for k, v in checkpoint().items() if k != "pytorch-lightning_version"},
            "which Lightning writes",
        ),
        (
            whole_checkpoint() | {"state_dict": {"other": torch.ones(3)}},
            "was made by another configuration",
        ),
        (checkpoint(loops={"x": 1}), "its loops have no fit_loop"),
        (checkpoint(optimizer=os.system), "could run code when read, so it isn't read: "),
    ],
)
def test_a_foreign_checkpoint_is_refused(launch, content, message):
    torch.save(content, "foreign.ckpt")
    # the loops are for training alone
    for stage in ("--train",) if content.get("loops") else ("--train", "--export"):
        code, err = launch("resume=foreign.ckpt", stage=stage)
        assert_refused(code, err, message)
        assert "weights_only" not in err  # torch's advice to read it all the same


def test_a_damaged_score_file_is_measured_anew(tmp_path):
    for content in (b"{bro", b"\xff", b"[1]"):
        (tmp_path / "metrics.json").write_bytes(content)
        assert evaluate.Measurements(None, tmp_path).values == {}


def test_a_file_in_the_place_of_a_folder_is_named(launch):
    TRIAL.mkdir(parents=True)
    (TRIAL / "save").touch()
    code, err = launch()
    assert code == 2 and f"cannot write {TRIAL}/save" in err and "Traceback" not in err


def test_a_full_disk_is_named(launch, monkeypatch):
    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device", "picture.png")

    monkeypatch.setattr(evaluate, "_write_png", full)
    code, err = launch()
    assert (
        code == 2
        and "cannot write picture.png: No space left on device" in err
        and "Traceback" not in err
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a: !!python/object/apply:os.system ['touch pwned']", "isn't valid YAML"),
        (b"\x89PNG\r\n\x1a\n", "can't be read"),
        (b"a:\n\tb: 1", "line 2, column 1"),
        (b"name: a\nname: b", "duplicate key"),
        (b"", "data_type is empty"),
        (b"system: []", "system is a list in one and a section in another"),
        (b"seed: " + 5000 * b"9", "isn't valid YAML: Exceeds the limit"),
        (b"#" * (1 << 21), "the configuration bad.yaml is larger than 1 MiB"),
        (b"data: [1, 2]", "data is a list in one and a section in another"),
    ],
)
def test_a_configuration_that_is_none_is_refused(launch, content, message):
    Path("bad.yaml").write_bytes(content)
    assert_refused(*launch(config="bad.yaml"), message)
    assert not Path("pwned").exists()


# -- prompts ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "prompt", ["1984", "a fox: red", "${x}", "../../x", "-x", "🦊" * 1000, "two\nlines", " "]
)
def test_a_prompt_arrives_verbatim_and_stays_in_the_output_root(launch, prompt):
    tagged_by_the_prompt = [option for option in SMALL if not option.startswith("tag=")]
    options = [
        *tagged_by_the_prompt,
        f"system.prompt_processor.prompt={prompt}",
        "trainer.max_steps=0",
        "trainer.limit_test_batches=0",
    ]
    assert experiment.main(["--config", str(DEMO), "--train", "--gpu", "cpu", *options]) == 0
    assert os.listdir() == ["outputs"]
    (parsed,) = Path("outputs").glob("demo/*/configs/parsed.yaml")
    assert load_config(parsed).system.prompt_processor.prompt == prompt


# -- extensions and signals ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = '\0'", "null bytes"),
        ("def f(:", "custom/part.py:1: invalid syntax"),
        ("import nothing", "custom/part.py:1: ModuleNotFoundError"),
    ],
)
def test_an_extension_that_fails_is_named(launch, source, message):
    Path("custom").mkdir()
    Path("custom/part.py").write_text(source)
    code, err = launch()
    assert_refused(code, err, message)
    assert "custom/part.py" in err


def test_a_signal_while_the_test_views_are_rendered_leaves_a_checkpoint_and_says_how_to_go_on(
    launch, monkeypatch, capsys
):
    with monkeypatch.context() as patch:
        patch.setattr(
            GaussianDreamerSystem, "test_step", lambda *args: os.kill(os.getpid(), signal.SIGINT)
        )
        code = experiment.main(["--config", str(DEMO), "--train", "--gpu", "cpu", *SMALL])
    out = capsys.readouterr().out
    last = TRIAL / "ckpts" / "last.ckpt"
    assert code == 130 and "to go on: " in out and f"resume={last}" in out
    shutil.rmtree(TRIAL / "save")
    assert launch(f"resume={last}")[0] == 0
    assert (TRIAL / "save" / "it2-export" / "gaussians.ply").is_file()


# -- runs that meet --------------------------------------------------------------------------------


def test_a_second_run_in_a_folder_is_refused_while_the_first_one_trains(launch):
    TRIAL.mkdir(parents=True)
    first = folder_lock.claim(TRIAL)
    code, err = launch()
    first.release()
    assert code == 2 and f"another run is training in {TRIAL}" in err and not list(TRIAL.iterdir())
    assert launch()[0] == 0


def test_a_run_that_is_resumed_at_its_end_is_measured(launch):
    """Also where the result's numbers aren't: in another folder, or because the first run was
    killed before it had them.
    """
    assert launch()[0] == 0
    code, err = launch(f"resume={TRIAL}/ckpts/last.ckpt", "tag=other")
    assert code == 0 and "nothing is left to train" in err
    first, other = (
        json.loads((folder / "save/metrics.json").read_text())["result"]
        for folder in (TRIAL, TRIAL.with_name("other"))
    )
    assert (other["step"], other["psnr"]) == (first["step"], first["psnr"])


@pytest.mark.parametrize("stage", ["validate", "test", "export"])
def test_nothing_to_resume_is_nothing_to_show(stage, launch):
    """Only training can start anew; an untrained cloud would pass for the result."""
    assert_refused(
        *launch("resume=auto", stage=f"--{stage}"),
        f"resume=auto: there is no checkpoint to --{stage}",
    )


def test_a_closed_pipe_is_no_traceback(monkeypatch, capsys):
    closed = []
    monkeypatch.setattr(
        experiment, "run", lambda *args: (_ for _ in ()).throw(BrokenPipeError(32, "Broken pipe"))
    )
    monkeypatch.setattr(os, "dup2", lambda _, to: closed.append(to))
    assert experiment.main(["--config", str(DEMO), "--train"]) == 128 + signal.SIGPIPE
    assert closed == [1] and "the reader of the output has closed it" in capsys.readouterr().err
