"""The toybox's models in the published formats: the package's own parts load them like
any model.
"""

import json
import shutil

import numpy as np
import pytest
import torch

from tests.promises.commands import full_disk
from tests.toybox.helpers import options, training
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import stable_diffusion  # noqa: F401
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.models.bundled import DIGESTS, digest_of, read_digests
from threestudio_gaussiandreamer.priors.point_e import PointEPrior
from threestudio_gaussiandreamer.prompts import prompt_processors  # noqa: F401
from threestudio_gaussiandreamer.toybox import models, train, views
from threestudio_gaussiandreamer.toybox.export import main
from threestudio_gaussiandreamer.toybox.kinds import KINDS
from threestudio_gaussiandreamer.toybox.loop import averaged_weights, is_trained
from threestudio_gaussiandreamer.toybox.tokens import open_tokenizer, token_ids
from threestudio_gaussiandreamer.toybox.train import STAGES

PROMPT = "a red fox with a green scarf"
HALF = {"rtol": 2e-3, "atol": 2e-3}
"""Float16 keeps eleven bits."""

pytestmark = pytest.mark.usefixtures("small_world")


@pytest.fixture(scope="module")
def unet_stage(trained):
    stage = STAGES["unet"](options(trained))
    stage.model.load_state_dict(averaged_weights(trained, "unet"))
    return stage


@torch.no_grad()
def hidden_states(stage, texts):
    return stage.text_model(token_ids(stage.tokenizer, texts)).last_hidden_state


def part(exported, kind, **options):
    model = {"pretrained_model_name_or_path": str(exported / "stable-diffusion")}
    return find(f"gaussiandreamer-stable-diffusion-{kind}")(model | options)


def test_the_prompt_processor_gives_the_tokens_of_the_training(exported, unet_stage):
    options = {"prompt": PROMPT, "negative_prompt": "", "use_cache": False}
    prompts = part(exported, "prompt-processor", **options)()
    texts = [PROMPT, "", f"{PROMPT}, side view", f"{PROMPT}, overhead view"]
    expected = hidden_states(unet_stage, texts)
    found = [prompts.text_embeddings, prompts.uncond_text_embeddings]
    found += [prompts.text_embeddings_vd[:1], prompts.text_embeddings_vd[3:]]
    assert torch.allclose(torch.cat(found), expected, **HALF)


def test_the_guidance_sees_what_the_training_saw(exported, unet_stage):
    guidance = part(exported, "guidance", guidance_scale=7.5)
    assert guidance.prediction_type == "v_prediction"
    assert guidance.image_size == 128
    assert torch.allclose(guidance.alphas_cumprod, unet_stage.alphas_cumprod)
    z = torch.randn(2, 4, 16, 16, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([50, 900])
    tokens = hidden_states(unet_stage, [PROMPT] * 2)
    v = unet_stage.model(z, t, encoder_hidden_states=tokens).sample
    abar = unet_stage.alphas_cumprod[t].float().reshape(-1, 1, 1, 1)
    expected = abar.sqrt() * v + (1 - abar).sqrt() * z
    assert torch.allclose(guidance.predict_rows(z, t, tokens), expected, **HALF)
    images = torch.rand(2, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    mean = guidance.vae.encode(images * 2 - 1).latent_dist.mean * guidance.vae.config.scaling_factor
    scale = unet_stage.constants["latent_scale"]
    expected = unet_stage.vae.encode(images * 2 - 1).latent_dist.mean * scale
    assert torch.allclose(mean, expected, **HALF)


def test_the_point_e_prior_loads_the_points_model(exported, trained):
    files = {"checkpoint": str(exported / "points.safetensors"), "clip": str(exported / "clip")}
    prior = PointEPrior({**files, "upsampler": None, "num_steps": 3, "num_points": 50})
    prior.preflight()
    cloud = prior(PROMPT)
    assert cloud.points.shape == (50, 3) and np.isfinite(cloud.points).all()
    stage = STAGES["points"](options(trained))
    assert torch.allclose(
        prior.condition("Point-E", exported / "clip", PROMPT)[:1],
        stage.condition(token_ids(stage.tokenizer, [PROMPT])),
        **HALF,
    )


def test_a_training_continues_from_the_weights_and_their_record(exported, trained, tmp_path):
    there = options(tmp_path)
    record = json.loads((exported / "training.json").read_text())
    assert set(record) == set(STAGES)
    assert record["clip"]["images"] == 8 and record["unet"]["steps"] == 1
    digests = read_digests(exported)
    assert {"points.safetensors", "clip/model.safetensors", "training.json"} < set(digests)
    assert all(digest_of(exported / name) == digest for name, digest in digests.items())
    record["judge"]["trainings"] = [{"device": "another", "hours": 0.1}]
    record["judge"]["last"] = {"images": 8, "seconds": 360.0, "loss": 0.5}
    weights = tmp_path / "weights"
    shutil.copytree(exported, weights)
    (weights / "training.json").write_text(json.dumps(record))
    tokenizer_before = (trained / "tokenizer" / "vocab.json").read_bytes()
    train.start_from(weights, there, STAGES)
    assert (tmp_path / "tokenizer" / "vocab.json").read_bytes() == tokenizer_before
    for name in STAGES:
        expected, found = averaged_weights(trained, name), averaged_weights(tmp_path, name)
        for key, value in expected.items():
            if "heads" not in key or name == "judge":
                assert torch.allclose(found[key], value, **HALF), key
        run = training(tmp_path, name)
        assert run.progress.earlier == record[name]["trainings"] and run.progress.seconds == 0
        assert run.progress.history == ([record[name]["last"]] if record[name]["last"] else [])
        before = run.progress.images
        assert before == training(trained, name).progress.images
        if name in ("unet", "motion", "judge"):
            run.run(before + 4)


def test_new_words_and_classes_are_added_to_weights():
    words, kinds = torch.tensor([[1.0], [2], [3]]), torch.tensor([5.0, 6])
    state = {"x.token_embedding.weight": words, "heads.kind.bias": kinds, "scale": torch.tensor(2)}
    own = {"x.token_embedding.weight": torch.zeros(5, 1), "heads.kind.bias": torch.zeros(3)}
    found = train.grown(state, own, [(0, 0), (3, 1), (4, 2)])
    assert [x.flatten().tolist() for x in found.values()] == [[1, 0, 0, 2, 3], [5, 6, 0], [2]]
    state["x.token_embedding.weight"] = words[:, :0]  # of another width
    with pytest.raises(RuntimeError):
        train.grown(state, own, [(0, 0)])
    # the classes of earlier judges keep their places
    assert views.LABELS["accessory"][:5] == ("hat", "scarf", "flag", "balloon", "none")
    assert views.LABELS["kind"][:16] == tuple(KINDS)


def test_weights_of_another_size_are_refused(exported, tmp_path, monkeypatch):
    monkeypatch.setattr(models, "VISION_LAYERS", 2)
    monkeypatch.setattr(models, "FEATURES", 64)
    with pytest.raises(UserError, match="'text'.*of another model"):
        train.start_from(exported, options(tmp_path), ["text"])


def test_a_full_disk_is_one_message_and_the_call_can_be_repeated(
    trained, exported, tmp_path, monkeypatch, capsys
):
    target = tmp_path / "models"
    for size in (100, 8000):  # in weights or vocabulary, and in a configuration
        with full_disk(size):
            assert main([str(trained), str(target)]) == 2
        assert "cannot write" in capsys.readouterr().err
    assert main([str(trained), str(target)]) == 0
    files = {path.relative_to(target).as_posix() for path in target.rglob("*") if path.is_file()}
    assert set(read_digests(target)) == files - {DIGESTS}
    monkeypatch.setattr(train, "STAGES", {"text": STAGES["text"]})
    for size in (3000, 20000):  # in the vocabulary, and in a checkpoint
        with full_disk(size), pytest.raises(UserError, match="cannot write"):
            train.start_from(exported, options(tmp_path), ["text"])
    train.start_from(exported, options(tmp_path), ["text"])
    assert is_trained(tmp_path, "text") and open_tokenizer(tmp_path)


def test_other_folders_are_named(tmp_path, capsys):
    assert main([str(tmp_path / "nothing"), str(tmp_path / "models")]) == 2
    assert "train the stage 'clip' first" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert main([str(tmp_path), str(tmp_path / "file" / "models")]) == 2
    assert "TARGET: the folder" in capsys.readouterr().err
    for content in (None, b"[]", b'{"text": 3}', b"\xff"):
        if content is not None:
            (tmp_path / "training.json").write_bytes(content)
        problem = "does not exist" if content is None else "training.json': it is .*damaged"
        with pytest.raises(UserError, match=problem):
            train.start_from(tmp_path, options(tmp_path / "run"), STAGES)
