"""Every shipped configuration builds, and every accepted key is read somewhere."""

import ast
import dataclasses
from pathlib import Path

import pytest

from threestudio_gaussiandreamer import host, register_parts
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.priors.base import Prior

register_parts()
ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "threestudio_gaussiandreamer"
CONFIGS = sorted(path.name for path in (ROOT / "configs").glob("*.yaml"))
OVERLAYS = (
    {f"demo-{name}.yaml": "demo.yaml" for name in ("small", "draft", "best")}
    | {
        f"gaussiandreamer-{name}.yaml": "gaussiandreamer.yaml"
        for name in (
            *("if", "sdxl", "sd3", "mvdream", "pointe"),
            *("avatar", "avatar-smpl", "ground", "lowmem", "paper"),
        )
    }
    | {"polish.yaml": "gaussiandreamer.yaml"}
    | {f"toybox-{name}.yaml": "toybox.yaml" for name in ("draft", "paper")}
)
"""What each is laid over."""
MANDATORY = {
    "gaussiandreamer-pointe.yaml": [
        "system.geometry.prior.checkpoint=base.pt",
        "system.geometry.prior.upsampler=upsample.pt",
    ],
    "gaussiandreamer-avatar-smpl.yaml": [
        "system.geometry.prior.motion=results.npz",
        "system.geometry.prior.body_model=body.npz",
    ],
    "polish.yaml": ["system.geometry.prior.path=fox.ply"],
}
"""The user's files where a configuration leaves them open."""


def loaded(name, tmp_path):
    paths = [ROOT / "configs" / part for part in (OVERLAYS.get(name), name) if part]
    overrides = [
        "system.prompt_processor.prompt=a fox",
        f"exp_root_dir={tmp_path}",
        *MANDATORY.get(name, []),
    ]
    cfg = load_config(*paths, cli_args=overrides)
    check_config(cfg)
    return cfg


@pytest.mark.parametrize("name", CONFIGS)
def test_a_shipped_configuration_is_valid_and_its_parts_can_be_built(name, tmp_path):
    cfg = loaded(name, tmp_path)
    data = host.find(cfg.data_type)(cfg.data)
    system = host.find(cfg.system_type)(cfg.system)
    assert len(system.geometry) == 0 and data.cfg.batch_size == (
        2 if name == "toybox-draft.yaml" else 4
    )
    assert system.cfg.exporter_type == "gaussiandreamer-exporter"


@pytest.mark.parametrize("name", CONFIGS)
def test_the_prior_of_a_shipped_configuration_can_be_built(name, tmp_path):
    """Built, not run: its options are accepted, and it looks for its files only on preflight."""
    geometry = loaded(name, tmp_path).system.geometry
    assert isinstance(host.find(geometry.prior_type)(geometry.prior), Prior)


def test_a_body_may_be_chosen_among_meshes_instead(tmp_path):
    prior = ["motion=''", "body_model=''", "candidates=[a.obj,b.obj]"]
    paths = [
        ROOT / "configs" / name
        for name in ("gaussiandreamer.yaml", "gaussiandreamer-avatar-smpl.yaml")
    ]
    cfg = load_config(
        *paths,
        cli_args=[
            "system.prompt_processor.prompt=a fox",
            *(f"system.geometry.prior.{o}" for o in prior),
        ],
    )
    check_config(cfg)
    assert list(host.find("motion-prior")(cfg.system.geometry.prior).cfg.candidates) == [
        "a.obj",
        "b.obj",
    ]


def test_overlays_can_be_combined(tmp_path):
    """An avatar on the ground with little memory: options of another prior are dropped, the rest is
    kept.
    """
    names = [
        "gaussiandreamer.yaml",
        "gaussiandreamer-lowmem.yaml",
        "gaussiandreamer-ground.yaml",
        "gaussiandreamer-avatar-smpl.yaml",
    ]
    overrides = [
        "system.prompt_processor.prompt=a fox",
        *MANDATORY["gaussiandreamer-avatar-smpl.yaml"],
    ]
    cfg = load_config(*(ROOT / "configs" / name for name in names), cli_args=overrides)
    check_config(cfg)
    prior = host.find(cfg.system.geometry.prior_type)(cfg.system.geometry.prior).cfg
    assert prior.ground and prior.motion == "results.npz" and cfg.system.guidance.enable_vae_slicing


@pytest.mark.parametrize("other", ["if", "pointe", "avatar", "avatar-smpl", "ground"])
@pytest.mark.parametrize("lowmem_first", [True, False])
def test_the_lowmem_overlay_combines_with_every_other_in_either_order(
    other, lowmem_first, tmp_path
):
    names = ["gaussiandreamer-lowmem.yaml", f"gaussiandreamer-{other}.yaml"]
    overrides = ["system.prompt_processor.prompt=a fox", *MANDATORY.get(names[1], [])]
    paths = [
        ROOT / "configs" / name
        for name in ("gaussiandreamer.yaml", *(names if lowmem_first else names[::-1]))
    ]
    cfg = load_config(*paths, cli_args=overrides)
    check_config(cfg)
    assert cfg.data.width == 512 and cfg.system.renderer.downsample == 1


def test_the_papers_numbers_are_the_papers(tmp_path):
    """Section 4.1 (implementation details) and 3.3 of the paper."""
    cfg = loaded("gaussiandreamer.yaml", tmp_path)
    system = host.find(cfg.system_type)(cfg.system)
    geometry, data = system.geometry.cfg, cfg.data
    assert [
        getattr(geometry, f"lr_{name}") for name in ("means", "opacities", "sh", "scales", "quats")
    ] == [
        5e-5,
        1e-2,
        1.25e-2,
        1e-3,
        1e-2,
    ]
    assert (
        geometry.init_opacity,
        geometry.sh_degree,
        geometry.grow.radius,
        list(geometry.grow.color_range),
    ) == (0.1, 0, 0.01, [0.0, 0.2])
    assert geometry.scale_rule == "nearest" and not geometry.densify.enabled
    assert (cfg.trainer.max_steps, data.batch_size, data.width, system.renderer.cfg.downsample) == (
        1200,
        4,
        1024,
        2,
    )
    assert (
        list(data.camera_distance_range) == [1.5, 4.0]
        and list(data.elevation_range) == [-10, 60]
        and list(data.azimuth_range) == [-180, 180]
    )
    steps = cfg.system.guidance.max_step_percent
    assert [host.C(steps, 0, step) for step in (0, 500, 501, 1199)] == [0.98, 0.98, 0.55, 0.55]
    assert cfg.system.guidance.guidance_scale == 101  # the host's 100


def test_the_released_codes_numbers_are_the_codes(tmp_path):
    cfg = loaded("gaussiandreamer-official.yaml", tmp_path)
    geometry = host.find(cfg.system_type)(cfg.system).geometry.cfg
    assert (
        host.C(geometry.lr_means, 0, 0) == 2e-4
        and geometry.lr_scales == 5e-3
        and geometry.lr_quats == 1e-3
    )
    assert (
        geometry.scale_rule == "rms3"
        and geometry.densify.enabled
        and geometry.densify.grad_threshold == 2e-4
    )
    assert geometry.grow.radius == 0.01  # of the longest side, which is 1 for its objects
    steps = [
        s
        for s in range(1, 1201)
        if geometry.densify.start <= s < geometry.densify.stop and s % geometry.densify.every == 0
    ]
    assert steps == [400, 500, 600, 700, 800]
    assert list(cfg.system.guidance.grad_clip) == [0, 1.5, 2.0, 1000]


def config_classes():
    """Return (part, Config) of everything registered by this package, nested dataclasses
    included.
    """
    found = {}
    for name in host.names():
        part = host.find(name)
        if part.__module__.startswith(PACKAGE.name) and dataclasses.is_dataclass(
            getattr(part, "Config", None)
        ):
            found[f"{name}"] = part.Config
            for field in dataclasses.fields(part.Config):
                if dataclasses.is_dataclass(field.type):
                    found[f"{name}.{field.name}"] = field.type
    return found


def names_that_are_read():
    """Return attributes, strings, keywords and parameters in the package's code, except in
    dataclass bodies.
    """
    read = set()
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                read.add(node.attr)
            elif (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and id(node) not in docstrings
            ):
                read |= set(node.value.replace(".", " ").split())
            elif isinstance(node, ast.arg):
                read.add(node.arg)
    return read


def test_every_accepted_key_is_read_by_somebody():
    read = names_that_are_read()
    unread = [
        f"{name}.{field.name}"
        for name, cls in config_classes().items()
        for field in dataclasses.fields(cls)
        if field.name not in read
    ]
    assert not unread, unread


@pytest.mark.parametrize(
    "overlay, overrides, prompt",
    [
        (None, [], "a painted toy"),
        (None, ["system.guidance.mesh=models/my fox.obj"], "my fox"),
        (None, ["system.guidance.mesh=a.obj", "system.prompt_processor.prompt=a fox"], "a fox"),
        ("polish.yaml", ["system.geometry.prior.path=fox.ply"], "fox"),
        ("system: {guidance: {mesh: b.glb}}", ["seed=3"], "b"),
        ("system: {guidance: {mesh: b.glb}, prompt_processor: {prompt: a bee}}", [], "a bee"),
    ],
)
def test_the_prompt_of_an_own_object_is_its_files_name(overlay, overrides, prompt, tmp_path):
    paths = [ROOT / "configs" / "demo.yaml"]
    if overlay:
        paths.append(
            ROOT / "configs" / overlay if overlay.endswith(".yaml") else tmp_path / "o.yaml"
        )
        if overlay.startswith("system"):
            paths[-1].write_text(overlay)
    cfg = load_config(*paths, cli_args=overrides)
    assert cfg.system.prompt_processor.prompt == prompt
    assert cfg.tag == prompt.replace(" ", "_")


def test_a_removed_option_of_a_section_within_is_named_and_dropped(caplog):
    cfg = load_config(
        ROOT / "configs" / "demo.yaml", cli_args=["system.geometry.prune.quality=0.3"]
    )
    check_config(cfg)
    said = "system.geometry.prune.quality is no option any more: budget=auto goes by prune.gain"
    assert said in caplog.text
    assert "quality" not in cfg.system.geometry.prune
