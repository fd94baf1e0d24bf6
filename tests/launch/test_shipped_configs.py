"""Every shipped configuration builds."""

from pathlib import Path

import pytest
import yaml

from tests.promises.test_configurations import FILES, PROMPT, stack
from threestudio_gaussiandreamer import host, register_parts
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.priors.base import Prior
from threestudio_gaussiandreamer.view.run_index import leaves

register_parts()
ROOT = Path(__file__).parents[2]
POLISH = (ROOT / "configs/polish.yaml").read_text()
CONFIGS = sorted(path.name for path in (ROOT / "configs").glob("*.yaml"))


def loaded(*names, overrides=()):
    """Load and check a configuration with others laid over it."""
    paths = [ROOT / "configs" / name for name in names]
    cfg = load_config(*paths, cli_args=[PROMPT, *overrides])
    check_config(cfg)
    return cfg


@pytest.mark.parametrize("name", CONFIGS)
def test_a_shipped_configuration_is_valid_and_its_parts_can_be_built(name):
    """Built, not run: the prior looks for its files only on preflight."""
    names = [word for word in stack(name) if word != "--config"]
    cfg = loaded(*names, overrides=FILES.get(name, []))
    data = host.find(cfg.data_type)(cfg.data)
    system = host.find(cfg.system_type)(cfg.system)
    assert data.cfg.batch_size == (2 if name == "toybox-draft.yaml" else 4)
    assert len(system.geometry) == 0 and system.cfg.exporter_type == "gaussiandreamer-exporter"
    geometry = cfg.system.geometry
    assert isinstance(host.find(geometry.prior_type)(geometry.prior), Prior)


def stacked(*names, overrides=()):
    """Load and check overlays of the paper's configuration."""
    return loaded(*(f"gaussiandreamer{name}.yaml" for name in ("", *names)), overrides=overrides)


def test_a_body_may_be_chosen_among_meshes_instead():
    prior = ["motion=''", "body_model=''", "candidates=[a.obj,b.obj]"]
    cfg = stacked("-avatar-smpl", overrides=[f"system.geometry.prior.{o}" for o in prior])
    built = host.find("motion-prior")(cfg.system.geometry.prior)
    assert list(built.cfg.candidates) == ["a.obj", "b.obj"]


@pytest.mark.parametrize("other", ["if", "pointe", "avatar-smpl"])
def test_the_lowmem_overlay_combines_with_others_in_either_order(other):
    files = FILES.get(f"gaussiandreamer-{other}.yaml", [])
    for names in (["-lowmem", f"-{other}"], [f"-{other}", "-lowmem"]):
        cfg = stacked(*names, overrides=files)
        assert cfg.data.width == 512 and cfg.system.renderer.downsample == 1
    if other == "avatar-smpl":  # on the ground: options of another prior are dropped
        cfg = stacked("-lowmem", "-ground", f"-{other}", overrides=files)
        prior = host.find(cfg.system.geometry.prior_type)(cfg.system.geometry.prior).cfg
        assert prior.ground and prior.motion == "results.npz"
        assert cfg.system.guidance.enable_vae_slicing


def test_avatars_of_the_toybox_differ_in_the_prior_only():
    """It repeats the other's numbers, so that it works alone."""
    names = [ROOT / f"configs/toybox{name}.yaml" for name in ("", "-avatar")]
    objects, avatars = (dict(leaves(yaml.safe_load(path.read_text()))) for path in names)
    differing = {key for key in objects | avatars if objects.get(key) != avatars.get(key)}
    assert all(key.startswith("system.geometry.prior") for key in differing - {"name"}), differing
    prior = loaded("toybox-avatar.yaml").system.geometry.prior
    assert prior.motion == prior.body_model == prior.clip == "toybox"


def test_the_papers_numbers_are_the_papers():
    """Section 4.1 (implementation details) and 3.3 of the paper."""
    cfg = loaded("gaussiandreamer.yaml")
    system = host.find(cfg.system_type)(cfg.system)
    geometry, data = system.geometry.cfg, cfg.data
    names = ("means", "opacities", "sh", "scales", "quats")
    rates = [getattr(geometry, f"lr_{name}") for name in names]
    assert rates == [5e-5, 1e-2, 1.25e-2, 1e-3, 1e-2]
    assert (geometry.init_opacity, geometry.sh_degree, geometry.grow.radius) == (0.1, 0, 0.01)
    assert list(geometry.grow.color_range) == [0.0, 0.2]
    assert geometry.scale_rule == "nearest" and not geometry.densify.enabled
    assert (cfg.trainer.max_steps, data.batch_size, data.width) == (1200, 4, 1024)
    assert system.renderer.cfg.downsample == 2
    assert list(data.camera_distance_range) == [1.5, 4.0]
    assert list(data.elevation_range) == [-10, 60] and list(data.azimuth_range) == [-180, 180]
    steps = cfg.system.guidance.max_step_percent
    assert [host.C(steps, 0, step) for step in (0, 500, 501, 1199)] == [0.98, 0.98, 0.55, 0.55]
    assert cfg.system.guidance.guidance_scale == 101  # the host's 100


def test_the_released_codes_numbers_are_the_codes():
    cfg = loaded("gaussiandreamer-official.yaml")
    geometry = host.find(cfg.system_type)(cfg.system).geometry.cfg
    rates = host.C(geometry.lr_means, 0, 0), geometry.lr_scales, geometry.lr_quats
    assert rates == (2e-4, 5e-3, 1e-3) and geometry.scale_rule == "rms3"
    assert geometry.grow.radius == 0.01  # of the longest side, which is 1 for its objects
    rule = geometry.densify
    assert rule.enabled and rule.grad_threshold == 2e-4
    steps = [s for s in range(1, 1201) if rule.start <= s < rule.stop and s % rule.every == 0]
    assert steps == [400, 500, 600, 700, 800]
    assert list(cfg.system.guidance.grad_clip) == [0, 1.5, 2.0, 1000]


@pytest.mark.parametrize(
    "overlay, overrides, prompt",
    [
        ("{}", [], "a painted toy"),
        ("{}", ["system.guidance.mesh=models/my fox.obj"], "my fox"),
        ("{}", ["system.guidance.mesh=a.obj", "system.prompt_processor.prompt=a fox"], "a fox"),
        (POLISH, ["system.geometry.prior.path=fox.ply"], "fox"),
        ("system: {guidance: {mesh: b.glb}}", ["seed=3"], "b"),
        ("system: {guidance: {mesh: b.glb}, prompt_processor: {prompt: a bee}}", [], "a bee"),
    ],
)
def test_the_prompt_of_an_own_object_is_its_files_name(overlay, overrides, prompt, tmp_path):
    (tmp_path / "overlay.yaml").write_text(overlay)
    cfg = load_config(ROOT / "configs/demo.yaml", tmp_path / "overlay.yaml", cli_args=overrides)
    assert cfg.system.prompt_processor.prompt == prompt
    assert cfg.tag == prompt.replace(" ", "_")


def test_a_removed_option_of_a_section_within_is_named_and_dropped(caplog):
    cfg = loaded("demo.yaml", overrides=["system.geometry.prune.quality=0.3"])
    said = "system.geometry.prune.quality is no option any more: budget=auto goes by prune.gain"
    assert said in caplog.text
    assert "quality" not in cfg.system.geometry.prune
