"""Finding models: folders, the cache, and a hub (a server here), also broken or absent."""

import json
import socket
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.helpers import tiny_models
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.extras import require_extra
from threestudio_gaussiandreamer.models import hub, model_files
from threestudio_gaussiandreamer.models.model_files import keep_loaded, load_counts, loaded

huggingface_hub = pytest.importorskip("huggingface_hub")
pytest.importorskip("diffusers")

TEXT = ("tokenizer", "text_encoder")
IMAGE = ("unet", "vae", "scheduler")
COMMIT = "1" * 40


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return tiny_models.stable_diffusion(tmp_path_factory.mktemp("models") / "tiny")


def copied(model, folder, *, without=()):
    for path in model.rglob("*"):
        name = path.relative_to(model)
        if path.is_file() and not any(name.match(pattern) for pattern in without):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(path.read_bytes())
    return folder


class FakeHub(BaseHTTPRequestHandler):
    """What a download uses of the hub; only the model ``people/tiny`` needs no login."""

    folder: Path
    asked: list[str]

    def log_message(self, *args):
        pass

    def do_HEAD(self):
        self.answer(body=False)

    def do_GET(self):
        self.answer(body=True)

    def answer(self, body):
        self.asked.append(self.path)
        path = self.path.split("?")[0]
        if path.startswith("/api/models/people/"):
            self.api(path)
        elif "people/gated" in path:
            said = "Access to model people/gated is restricted."
            self.reply(403, b"", {"X-Error-Code": "GatedRepo", "X-Error-Message": said}, body)
        elif "/resolve/" in path:
            content = (self.folder / path.split("/resolve/")[1].split("/", 1)[1]).read_bytes()
            self.reply(200, content, {"X-Repo-Commit": COMMIT, "ETag": f'"{hash(content)}"'}, body)
        else:
            said = "Repository not found"
            self.reply(401, b"", {"X-Error-Code": "RepoNotFound", "X-Error-Message": said}, body)

    def api(self, path):
        names = model_files.files_below(self.folder)
        sizes = {name: (self.folder / name).stat().st_size for name in names}
        if "/tree/" in path:
            same = {"type": "file", "oid": "0" * 40}
            content = [same | {"path": name, "size": size} for name, size in sizes.items()]
        else:
            siblings = [{"rfilename": name, "size": size} for name, size in sizes.items()]
            content = {"id": "/".join(path.split("/")[3:5]), "sha": COMMIT, "siblings": siblings}
        self.reply(200, json.dumps(content).encode(), {})

    def reply(self, status, content, headers, body=True):
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(content)


@pytest.fixture
def online(model, tmp_path, monkeypatch):
    """Start a hub with the tiny model and files that must not be downloaded; return its handler."""
    published = copied(model, tmp_path / "published")
    unet = "unet/diffusion_pytorch_model"
    for name in (f"{unet}.bin", f"{unet}.non_ema.safetensors", "v2-1_512.safetensors"):
        (published / name).write_bytes(b"not wanted")
    for component in ("unet", "vae"):
        weights = published / component / "diffusion_pytorch_model.safetensors"
        weights.with_suffix(".fp16.safetensors").write_bytes(weights.read_bytes())
    handler = type("Handler", (FakeHub,), {"folder": published, "asked": []})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    connect_to(monkeypatch, tmp_path, f"http://127.0.0.1:{server.server_port}")
    yield handler
    server.shutdown()
    server.server_close()


def connect_to(monkeypatch, cache, address):
    """Point the library, which has read its environment, at a test hub and an empty cache."""
    monkeypatch.setenv("HF_ENDPOINT", address)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(cache / "cache"))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)


def test_a_folder_needs_no_network_and_near_ones_are_named(model, monkeypatch, tmp_path):
    refused("no such folder.*near.*tiny", hub.find_model, str(model.parent / "tini"), TEXT)
    for name in ("./models/none", "no-owner", "../a/b", "a/b/c", "a\0b", "x" * 5000, "a/b.git"):
        refused("no such folder", hub.find_model, name, TEXT)
    # "models/tini" could be a model of the owner "models" too
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    copied(model, tmp_path / "models" / "tiny")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"The folder 'models' has no 'tini' \(near: models/tiny\)"):
        hub.find_model("models/tini", IMAGE)
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: pytest.fail("asked the network"))
    assert hub.find_model(str(model), (*TEXT, *IMAGE)) == model


def test_folders_without_usable_weights_are_named(model, tmp_path):
    with pytest.raises(UserError, match="unet/config.json is missing.*format of diffusers"):
        hub.find_model(str(tmp_path), ["unet"])
    folder = copied(model, tmp_path / "tiny")
    (weights,) = (folder / "unet").glob("*.safetensors")
    weights.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    refused("unet/.*safetensors is a pointer of Git LFS", hub.find_model, str(folder), IMAGE)
    weights.rename(weights.with_suffix(".bin"))
    refused("pickled.*safe_serialization", hub.find_model, str(folder), ["unet"])
    (folder / "tokenizer" / "merges.txt").unlink()
    with pytest.raises(UserError, match="tokenizer/merges.txt, are missing; .*pickled"):
        hub.find_model(str(folder), ["tokenizer", "unet"])


@pytest.mark.parametrize("variant", ["fp16", "bf16"])
def test_the_wanted_precision_is_preferred_and_the_other_one_will_do(variant):
    full, pick = "unet/model.safetensors", model_files.component_weights
    for name in ("model.{}", "model.{}-00001-of-00001", "model-00001-of-00001.{}"):
        half = f"unet/{name.format(variant)}.safetensors"
        assert pick([half, full], "unet", half=True) == ([half], variant, True)
        assert pick([half, full], "unet", half=False) == ([full], None, True)
        assert pick([half], "unet", half=False) == ([half], variant, True)
        assert pick([full], "unet", half=True) == ([full], None, True)
    shards = [f"unet/model-0000{i}-of-00003.safetensors" for i in (1, 2, 3)]
    assert pick(["unet/config.json", *shards], "unet") == (shards, None, True)
    refused(r"some of unet/\*.safetensors are missing", pick, shards[:-1], "unet")


def test_the_fingerprint_is_of_the_content_and_missing_weights_are_not_made_up(model, tmp_path):
    moved = copied(model, tmp_path / "moved")
    assert model_files.fingerprint(moved, TEXT) == model_files.fingerprint(model, TEXT)
    assert model_files.fingerprint(moved, IMAGE) != model_files.fingerprint(moved, TEXT)
    weights = moved / "text_encoder" / "model.safetensors"
    *others, last = weights.read_bytes()
    weights.write_bytes(bytes([*others, last ^ 1]))
    assert model_files.fingerprint(moved, TEXT) != model_files.fingerprint(model, TEXT)
    from diffusers import UNet2DConditionModel
    from safetensors.torch import load_file, save_file

    folder = copied(model, tmp_path / "holed")
    path = folder / "unet" / "diffusion_pytorch_model.safetensors"
    tensors = load_file(path)
    del tensors["conv_in.weight"]
    save_file(tensors, path, metadata={"format": "pt"})
    with pytest.raises(UserError, match="unet of the model .* lacks weights: conv_in.weight"):
        model_files.load_network(UNet2DConditionModel, folder, "unet")


def test_only_what_is_needed_is_downloaded_and_then_read_from_the_disk(online, monkeypatch):
    folder = hub.find_model("people/tiny", IMAGE)
    wanted = {f"{part}/diffusion_pytorch_model.safetensors" for part in ("unet", "vae")}
    wanted |= {"model_index.json", "unet/config.json", "vae/config.json"}
    wanted |= {"scheduler/scheduler_config.json"}
    assert set(model_files.files_below(folder)) == wanted
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    online.asked.clear()
    assert hub.find_model("people/tiny", IMAGE) == folder
    assert not online.asked
    refused("HF_HUB_OFFLINE", hub.find_model, "people/tiny", TEXT)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    assert set(model_files.files_below(hub.find_model("people/tiny", TEXT))) > wanted


def test_half_precision_downloads_the_small_files(online):
    names = model_files.files_below(hub.find_model("people/tiny", IMAGE, half=True))
    found = {name for name in names if name.endswith(".safetensors")}
    assert found == {f"{part}/diffusion_pytorch_model.fp16.safetensors" for part in ("unet", "vae")}


@pytest.mark.parametrize(
    "name, said",
    [
        ("people/gated", "gated: accept .* https://huggingface.co/people/gated .*hf auth login"),
        ("missing/model", "not on the hub, or is private.*hf download missing/model"),
        ("stabilityai/stable-diffusion-2-1-base", "'sd2-community/stable-diff.*' is a copy"),
    ],
)
def test_what_the_hub_does_not_give_is_explained(online, name, said):
    refused(said, hub.find_model, name, IMAGE)
    error = OSError(28, "No space left on device")
    assert "HF_HOME" in hub.explain(hub.Source("a/b", list), error)


def test_a_hub_model_without_safe_weights(online):
    for name in ("", ".fp16", ".non_ema"):
        (online.folder / "unet" / f"diffusion_pytorch_model{name}.safetensors").unlink()
    refused("people/tiny.*pickled", hub.find_model, "people/tiny", IMAGE)


def test_no_network_and_no_libraries_are_one_clear_message(monkeypatch, tmp_path):
    connect_to(monkeypatch, tmp_path, "http://hub.invalid")

    def blocked(*args, **kwargs):
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", blocked)
    said = "could not be reached.*--local-dir models/tiny.*HF_ENDPOINT"
    refused(said, hub.find_model, "people/tiny", IMAGE)
    require_extra("diffusion", "json")
    monkeypatch.setitem(sys.modules, "diffusers", None)
    said = r"needs diffusers .*pip install 'threestudio-gaussiandreamer\[diffusion\]'"
    refused(said, require_extra, "diffusion", "json", "diffusers")


def test_a_network_is_loaded_once_for_each_key_if_networks_are_kept_and_again_after_an_error():
    keep_loaded(False)
    assert loaded(("unet", "a"), object) is not loaded(("unet", "a"), object)
    keep_loaded()
    one = loaded(("unet", "a", "float32"), object)
    assert loaded(("unet", "a", "float32"), object) is one
    assert loaded(("unet", "a", "float16"), object) is not one
    assert loaded(("vae", "a", "float32"), object) is not one
    with pytest.raises(ZeroDivisionError):
        loaded(("unet", "b"), lambda: 1 / 0)
    assert loaded(("unet", "b"), lambda: 3) == 3 and load_counts() == {"unet": 3, "vae": 1}
    keep_loaded(False)
