"""The files of 3D models: which are needed and may be read, in folders, the hub's cache and on the
hub. Tested with Shap-E's.
"""

import os
import shutil
import sys

import numpy as np
import pytest
import torch

from tests.priors.shap_e_cases import CPU, FAST, make, seeded
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.models.hub import locate
from threestudio_gaussiandreamer.priors.shap_e import ShapEPrior


class Evil:
    def __reduce__(self):
        return (exec, ("import os; os.environ['EVIL'] = '1'",))


def test_preflight_finds_a_whole_folder(folder):
    assert make(folder).preflight() is None


@pytest.mark.parametrize(
    "missing",
    [
        "prior/config.json",
        "scheduler/scheduler_config.json",
        "tokenizer",
        "shap_e_renderer/diffusion_pytorch_model.safetensors",
    ],
)
def test_an_incomplete_folder_is_named(copy, missing):
    for path in [copy / missing] if (copy / missing).is_file() else (copy / missing).iterdir():
        path.unlink()
    with pytest.raises(UserError, match=missing.rsplit("/", 1)[0]):
        make(copy).preflight()


def to_bin(folder, part="shap_e_renderer"):
    """Convert this part to a pickle only, as on the hub's main branch."""
    from safetensors.torch import load_file

    weights = folder / part / "diffusion_pytorch_model.safetensors"
    torch.save(load_file(weights), weights.with_suffix(".bin"))
    weights.unlink()
    return weights.with_suffix(".bin")


def test_a_bin_is_read_when_allowed_and_only_then(copy, folder):
    to_bin(copy)
    with pytest.raises(UserError, match="allow_bin"):
        make(copy).preflight()
    np.testing.assert_array_equal(
        make(copy, allow_bin=True)("a fox").points, make(folder)("a fox").points
    )


def test_an_allowed_bin_cannot_run_code(copy, monkeypatch):
    monkeypatch.delenv("EVIL", raising=False)
    torch.save({"weight": Evil()}, to_bin(copy))
    with pytest.raises(UserError, match="shap_e_renderer"):
        make(copy, allow_bin=True)("a fox")
    assert "EVIL" not in os.environ


def test_half_precision_files_are_taken_where_there_are_no_others(copy, folder):
    from diffusers import PriorTransformer

    PriorTransformer.from_pretrained(copy / "prior").half().save_pretrained(
        copy / "prior", variant="fp16"
    )
    (copy / "prior" / "diffusion_pytorch_model.safetensors").unlink()
    half, full = (make(where)._sample(where, "a fox", CPU, seeded()) for where in (copy, folder))
    assert (
        half.dtype == torch.float32 and 0 < (half - full).abs().max() < 0.05
    )  # rounded weights, float32 arithmetic


def test_weights_that_are_not_in_the_file_are_no_noise(copy):
    from safetensors.torch import load_file, save_file

    weights = copy / "prior" / "diffusion_pytorch_model.safetensors"
    state = load_file(weights)
    del state["proj_in.weight"]
    save_file(state, weights, metadata={"format": "pt"})
    with pytest.raises(UserError, match="proj_in.weight"):
        make(copy)("a fox")


def test_damaged_weights_are_a_message(copy):
    (copy / "prior" / "diffusion_pytorch_model.safetensors").write_bytes(b"\0" * 100)
    with pytest.raises(UserError, match="prior of the model .* can't be loaded"):
        make(copy)("a fox")


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


@pytest.fixture
def online(empty_cache, monkeypatch):
    """Make the library assume that the hub is reachable."""
    from huggingface_hub import constants

    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    return empty_cache


def test_offline_without_the_model_says_what_to_do(empty_cache, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(UserError, match="hf download openai/shap-e.*folder"):
        ShapEPrior({}).preflight()


def test_offline_with_the_model_in_the_cache_works(empty_cache, folder, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    repository = empty_cache / "models--openai--shap-e"
    shutil.copytree(folder, repository / "snapshots" / ("0" * 40))
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("0" * 40)
    np.testing.assert_array_equal(ShapEPrior(FAST)("a fox").points, make(folder)("a fox").points)


def test_what_the_hub_refuses_names_the_option(online, monkeypatch):
    import huggingface_hub

    def refuse(self, *args, **kwargs):
        raise TimeoutError("timed out")

    monkeypatch.setattr(huggingface_hub.HfApi, "model_info", refuse)
    command = (
        "hf download some/model --revision refs/pr/11 --include '\\*/\\*' --exclude "
        "'renderer/\\*' --local-dir models/model"
    )
    with pytest.raises(
        UserError, match=f"reached .timed out.*`{command}`; then set system.geometry.prior.model"
    ):
        ShapEPrior({"model": "some/model", "revision": "refs/pr/11"}).preflight()


def test_preflight_on_the_hub_downloads_nothing(online, folder, monkeypatch):
    import huggingface_hub

    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*")]
    listing = type(
        "Info",
        (),
        {"siblings": [type("File", (), {"rfilename": name, "size": 1}) for name in names]},
    )
    monkeypatch.setattr(huggingface_hub.HfApi, "model_info", lambda self, *args, **kwargs: listing)
    ShapEPrior({"model": "some/model"}).preflight()
    assert not online.exists()


def test_only_needed_files_are_downloaded(online, folder, monkeypatch):
    import huggingface_hub

    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    listing = type(
        "Info",
        (),
        {
            "siblings": [
                type("File", (), {"rfilename": name, "size": 1})
                for name in [*names, "renderer/old.bin"]
            ]
        },
    )
    monkeypatch.setattr(huggingface_hub.HfApi, "model_info", lambda self, *args, **kwargs: listing)
    fetched = []

    def download(model, **options):
        if options.get("local_files_only"):
            raise FileNotFoundError
        fetched.extend(options["allow_patterns"])
        return str(folder)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    assert locate(make("some/model")._source()) == folder
    assert {"prior/diffusion_pytorch_model.safetensors", "tokenizer/tokenizer_config.json"} <= set(
        fetched
    )
    assert not any(name.startswith(("renderer", "vocabulary")) for name in fetched)


def test_without_diffusers_the_extra_is_named(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(UserError, match=r"pip install 'threestudio-gaussiandreamer\[diffusion\]'"):
        make(folder)("a fox")
