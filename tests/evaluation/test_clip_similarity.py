"""CLIP similarity by the paper's protocol with a tiny CLIP, and T3Bench's folders."""

import contextlib
import io
import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.evaluation.conftest import blob, run_of, save
from tests.helpers import tiny_3d_models as tiny
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
from threestudio_gaussiandreamer.evaluation import clip_similarity as module
from threestudio_gaussiandreamer.evaluation import results, t3bench
from threestudio_gaussiandreamer.evaluation.clip_similarity import Protocol, main
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.launch.config import dump_config, load_config
from threestudio_gaussiandreamer.launch.options import find_config

register_parts()
FAST = ["--size", str(tiny.IMAGE_SIZE), "--seeds", "0", "1", "2"]
PROMPT = "a painted toy"


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    pytest.importorskip("transformers")
    return str(tiny.clip(tmp_path_factory.mktemp("models") / "clip"))


def written(folder):
    text = (Path(folder) / "clip.json").read_text(encoding="utf-8", errors="surrogateescape")
    return json.loads(text)


def test_the_views_are_the_papers():
    orbit = Protocol().orbit
    assert Protocol().drawn == 10
    torch.testing.assert_close(orbit.azimuth, torch.arange(-180.0, 178, 3))
    position = orbit.c2w[:, :3, 3]
    torch.testing.assert_close(position.norm(dim=1), torch.full((120,), 4.0))
    torch.testing.assert_close(torch.asin(position[:, 2] / 4), torch.full((120,), math.radians(15)))
    # a seed draws ten different views of every result
    draws = [Protocol().draw(seed, item) for seed in range(3) for item in range(3)]
    for draw in draws:
        assert len(set(draw)) == 10 and 0 <= draw.min() and draw.max() < 120
    assert len({tuple(draw) for draw in draws}) == 9
    np.testing.assert_array_equal(draws[4], Protocol().draw(1, 1))


@pytest.fixture(scope="module")
def scored(clip, tmp_path_factory):
    """Two results, one's path not UTF-8, scored with three seeds; a link is the report."""
    folder = tmp_path_factory.mktemp("scored")
    names = [folder / "0.ply", Path(os.fsdecode(os.fsencode(folder) + b"/caf\xe9.ply"))]
    plys = [str(save(name, blob(seed=i))) for i, name in enumerate(names)]
    (folder / "mine").write_text("mine")
    (folder / "out").mkdir()
    (folder / "out/clip.json").symlink_to(folder / "mine")
    arguments = ["--clip", clip, "--prompt", PROMPT, "--output", str(folder / "out"), *FAST]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main([*plys, *arguments]) == 0
    return plys, folder / "out", said.getvalue()


def test_the_score_is_transformers_cosine_over_the_seeds(clip, scored):
    """Repeats the computation: render the drawn views, use transformers' features, average."""
    from transformers import CLIPModel, CLIPTokenizer

    plys, out, _ = scored
    model, tokenizer = CLIPModel.from_pretrained(clip).eval(), CLIPTokenizer.from_pretrained(clip)
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073])
    std = torch.tensor([0.26862954, 0.26130258, 0.27577711])
    protocol, means = Protocol(size=tiny.IMAGE_SIZE), []
    for item, ply in enumerate(plys):
        orbit = protocol.orbit.rows(protocol.draw(1, item))
        cloud, view = results.read_result(results.find_result(ply)), (orbit.c2w, orbit.fovy)
        images = np.concatenate(list(results.render_views(cloud, *view, protocol.size)))
        pixels = ((torch.from_numpy(images) - mean) / std).permute(0, 3, 1, 2)
        with torch.no_grad():
            found = model(pixel_values=pixels, **tokenizer(PROMPT, return_tensors="pt"))
        cosine = torch.nn.functional.cosine_similarity(found.image_embeds, found.text_embeds)
        means.append(100 * float(cosine.mean()))
    found = written(out)
    # float32 features, times 100
    each = [result["per_seed"][1] for result in found["results"]]
    assert each == pytest.approx(means, abs=1e-4)
    assert found["per_seed"][1] == pytest.approx(sum(means) / 2, abs=1e-4)
    _, out, said = scored
    found = written(out)
    each = np.array([result["per_seed"] for result in found["results"]])
    np.testing.assert_allclose(found["per_seed"], each.mean(axis=0))
    spread = pytest.approx(each.mean(axis=0).std(ddof=1))
    assert found["mean"] == pytest.approx(each.mean()) and found["std"] == spread
    assert found["std"] > 0 and found["protocol"]["views"] == 120
    assert f"{found['mean']:.2f} +- {found['std']:.2f} over 3 seeds" in said
    sheet = np.asarray(Image.open(out / "clip.png"))
    assert sheet.shape == (2 * module.THUMBNAIL, 10 * module.THUMBNAIL, 3)
    assert sheet[80, 80, 0] > 100 > sheet[80, 80, 1]  # a red blob
    assert (out.parent / "mine").read_text() == "mine"
    assert b"caf\xe9.ply" in (out / "clip.json").read_bytes()


def test_weights_in_several_files_are_the_same_clip(clip, scored, tmp_path):
    """As the largest CLIP, ViT-bigG-14, is published. The same command gives the same numbers."""
    from transformers import CLIPModel

    plys, out, _ = scored
    sharded = tmp_path / "sharded"
    shutil.copytree(clip, sharded)
    (sharded / "model.safetensors").unlink()
    CLIPModel.from_pretrained(clip).save_pretrained(sharded, max_shard_size="20KB")
    assert len(list(sharded.glob("model-*.safetensors"))) > 1
    options = ["--prompt", PROMPT, "--output", str(tmp_path), *FAST]
    assert main([*plys, "--clip", str(sharded), *options]) == 0
    # how the weights lie in memory changes the order of float32 sums
    assert written(tmp_path)["per_seed"] == pytest.approx(written(out)["per_seed"], rel=1e-5)
    next(sharded.glob("model-*.safetensors")).unlink()
    refused(r"--clip.*some of \*.safetensors are missing", module.open_clip, str(sharded))


def test_a_runs_folder_brings_its_prompt_and_background(clip, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    prompt = "a {b} ${c} fox"
    options = ["system.background.color=[0.0,0.5,1.0]", f"system.prompt_processor.prompt={prompt}"]
    (tmp_path / "run/configs").mkdir(parents=True)
    dump_config("run/configs/parsed.yaml", load_config(find_config("demo.yaml"), cli_args=options))
    save(tmp_path / "run/save/it1-export/gaussians.ply", blob())
    result = results.find_result("run")
    assert result.file == Path("run/save/it1-export/gaussians.ply")
    assert result.prompt == prompt and result.background == (0.0, 0.5, 1.0)
    view = Protocol().orbit.c2w[:1], torch.tensor([1.2]), 16
    cloud = results.read_result(result)
    (image,) = results.render_views(cloud, *view, background=result.background)
    np.testing.assert_allclose(image[0, 0, 0], [0.0, 0.5, 1.0], atol=1e-6)
    assert main(["run", "--clip", clip, "--seeds", "3", "--size", "24"]) == 0
    found = written("evaluation")
    assert found["results"][0]["prompt"] == prompt and found["std"] is None


@pytest.mark.parametrize(
    ("kind", "options", "state", "color"),
    [
        ("gaussiandreamer-background", {"mode": "learned"}, {"logit": torch.zeros(3)}, (0.5,) * 3),
        ("solid-color-background", {"learned": True}, {"env_color": torch.ones(3)}, (1.0,) * 3),
        ("solid-color-background", {}, {}, (1.0,) * 3),
        ("own-background", {"color": [0.25, 0.5, 1.0]}, {}, (0.25, 0.5, 1.0)),
    ],
)
def test_the_background_is_the_learned_one_or_named(tmp_path, capsys, kind, options, state, color):
    system = {"background_type": kind, "background": options, "prompt_processor": {}}
    run_of(tmp_path, system)
    state_dict = {f"background.{name}": value for name, value in state.items()}
    content = {"state_dict": state_dict, "epoch": 0, "global_step": 1}
    save_file(tmp_path / "ckpts" / "last.ckpt", content)
    assert results.find_result(str(tmp_path)).background == color


def test_a_prompt_of_a_library_is_compared_as_its_text(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_of(tmp_path, {"prompt_processor": {"prompt": "lib:corgi"}})
    library = tmp_path / "load" / "prompt_library.json"
    library.parent.mkdir()
    library.write_text('["a corgi in the snow", "a fox"]')
    assert results.find_result(str(tmp_path)).prompt == "a corgi in the snow"
    library.unlink()
    refused("Give --prompt", module.prompts_for, [results.find_result(str(tmp_path))], None, None)


def test_of_the_last_export_the_ply_is_taken_and_one_line_of_the_list(tmp_path, plys):
    for name in ("it200-export/a.ply", "it1200-export/a.spz", "it1200-export/a.ply"):
        save(tmp_path / "save" / name, blob())
    assert results.find_result(str(tmp_path)).file == tmp_path / "save/it1200-export/a.ply"
    save(tmp_path / "save/it1201-export/a.spz", blob())
    assert results.find_result(str(tmp_path)).file.name == "a.spz"
    found = [results.find_result(ply) for ply in plys]
    file = tmp_path / "prompts.txt"
    file.write_text("a fox\n\n  a cat \n", encoding="utf-8")
    assert module.prompts_for(found, None, str(file)) == ["a fox", "a cat"]
    refused("2 prompts for 1 results", module.prompts_for, found[:1], None, str(file))


@pytest.mark.parametrize("antialiased", [False, True])
def test_clouds_are_drawn_with_the_antialiasing_of_their_training(tmp_path, antialiased):
    ply, small = run_of(tmp_path, {"renderer": {"antialias": antialiased}}), blob()
    small.log_scales[:] -= 3
    write_cloud(str(ply), StoredCloud(small, antialiased=antialiased))
    for place in (ply, tmp_path):
        assert results.find_result(str(place)).antialiased == antialiased
    orbit = Protocol().orbit.rows(slice(1))
    drawn, other = (
        next(results.render_views(small, orbit.c2w, orbit.fovy, 32, antialias=flag)).sum()
        for flag in (True, False)
    )
    assert drawn < other


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing.ply", "--clip", "x"], "missing.ply"),
        (["{folder}", "--clip", "x", "--prompt", "a"], "it*-export"),
        (["{ply}", "--clip", "nowhere", "--prompt", "a"], "--clip nowhere: expected a folder"),
        (["{ply}", "--clip", "{folder}", "--prompt", "a"], "config.json"),
        (["{ply}", "--clip", "x"], "what was"),
        (["{ply}", "--prompt", "a"], "--clip"),
        (["{ply}", "--clip", "x", "--prompt", "a", "--size", "0"], "--size"),
        (["{ply}", "--clip", "x", "--prompt", "a", "--fovy", "180"], "--fovy"),
        (["{ply}", "--clip", "toybox", "--prompt", "a", "--fovy", "60"], "--fovy has no effect"),
        (["{ply}", "--clip", "x", "--prompt", "a", "--size", "100000"], "got 100000"),
        (["{ply}", "--clip", "x", "--prompt", "a", "--output", "{ply}/o"], "can't be made"),
        (["{ply}", "--prompt", "a", "--t3bench", "{ply}/o"], "can't be made"),
        *(
            (["{ply}", "--prompt", text, "--t3bench", "{folder}"], "T3Bench names folders")
            for text in ("a/b", "..", "", 300 * "x")
        ),
        (["{ply}", "{ply}", "--prompt", "a", "--t3bench", "{folder}"], "given twice"),
        (["{ply}", "--prompt", "a", "--t3bench", "x", "--t3bench-method", "../x"], "bench-method"),
    ],
)
def test_mistakes_are_one_message(arguments, said, plys, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert main([word.format(folder=tmp_path / "empty", ply=plys[0]) for word in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and said in error


def t3bench_pose(v):
    """Return T3Bench's camera: towards the centre, +z up, or +y near the poles."""
    back = v / np.linalg.norm(v)
    up = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, v], axis=1)
    return pose


def test_the_cameras_are_t3benchs_and_the_object_is_centred_and_scaled(monkeypatch):
    monkeypatch.setattr(t3bench, "SIZE", 8)
    drawn = []
    monkeypatch.setattr(t3bench, "render_views", lambda _, *views, **how: drawn.extend(views))
    t3bench.pictures(blob())
    positions = drawn[0][::5, :3, 3].numpy()
    assert drawn[0].shape == (810, 4, 4) and drawn[2] == 8
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 2.2, rtol=1e-6)
    assert (np.abs(positions[:, 2]) > 2.19).sum() == 2  # the poles, where +z can't be up
    poses = np.repeat([t3bench_pose(v) for v in positions], 5, 0)
    np.testing.assert_allclose(drawn[0], poses, atol=2e-6)
    np.testing.assert_allclose(drawn[1][:10].reshape(2, 5), [t3bench.FOVY] * 2)
    arrays = blob(center=(3.0, -1.0, 0.5))
    arrays.means[0], arrays.logit_opacities[0] = 100.0, -8.0
    found = t3bench.normalized(arrays)
    visible = found.means[1:]
    np.testing.assert_allclose(visible.mean(axis=0), 0, atol=1e-5)
    assert np.abs(visible).max() == pytest.approx(1)
    scale = (visible[1] - visible[2])[0] / (arrays.means[2] - arrays.means[3])[0]
    wanted = scale * np.exp(arrays.log_scales)
    np.testing.assert_allclose(np.exp(found.log_scales), wanted, rtol=1e-4)


def test_t3benchs_scripts_find_their_mesh(plys, tmp_path):
    import trimesh

    prompt, root = "A cat's blue hat", tmp_path / "T3Bench"
    options = ["--t3bench-method", "dreamfusion"]
    assert main([plys[0], "--prompt", prompt, "--t3bench", str(root), *options]) == 0
    runs = root / "outputs_mesh_t3/dreamfusion_single"
    (path,) = runs.glob(f"{prompt.replace(' ', '_')}*/save/it*-export/model.obj")
    mesh = trimesh.load(path)  # as T3Bench's renderer does
    assert isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 100
    color = mesh.visual.vertex_colors[:, :3].mean(axis=0) / 255
    np.testing.assert_allclose(color, [0.9, 0.1, 0.1], atol=0.01)
