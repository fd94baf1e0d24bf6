"""Models that are missing are named within seconds."""

import ast
import socket
import time

import pytest

from tests.stability.rows import row
from tests.stability.small_runs import launch
from tests.stability.untrusted_files_cases import PACKAGE
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.models import hub

register_parts()


# ---- no network ----------------------------------------------------------------------------------


@pytest.fixture
def empty_cache(monkeypatch, tmp_path):
    pytest.importorskip("huggingface_hub.hf_api")  # not while the time is measured
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))


def refuse(*args, **kwargs):
    raise OSError(101, "Network is unreachable")


def hang(*args, **kwargs):
    time.sleep(30)


@row("A5", "Hub offline")
@pytest.mark.parametrize(
    "what", ["sockets blocked", "no answer to connecting", "no answer to a name", "HF_HUB_OFFLINE"]
)
def test_a_missing_model_is_named_within_seconds(what, empty_cache, monkeypatch, measured):
    """The message says which files to put where. Name resolution takes longest, because it has no
    timeout.
    """
    if what == "HF_HUB_OFFLINE":
        monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    elif what == "no answer to a name":
        monkeypatch.setattr(socket, "getaddrinfo", hang)
    elif what == "no answer to connecting":
        silent = socket.create_server(("127.0.0.1", 0))
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
    monkeypatch.setattr(socket.socket, "connect", refuse) if what == "sockets blocked" else None
    if what != "HF_HUB_OFFLINE":
        assert hub.TIMEOUT <= 4.5
        if what != "sockets blocked":
            monkeypatch.setattr(hub, "TIMEOUT", 0.5)  # users' timeouts are 8 times as long
    start = time.monotonic()
    with pytest.raises(
        UserError,
        match="hf download .*--local-dir models/model`; then set "
        ".*pretrained_model_name_or_path to that folder",
    ):
        hub.find_model("missing/model", ("unet", "vae"))
    seconds = time.monotonic() - start
    scale = 1.0 if what in ("sockets blocked", "HF_HUB_OFFLINE") else hub_seconds() / 0.5
    measured(seconds * scale, "s", what="time to the message", at_most=5.0)


def hub_seconds() -> float:
    """Return the timeout that users have, whatever a test has set."""
    tree = ast.parse((PACKAGE / "models/hub.py").read_text())
    return next(
        node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and node.targets[0].id == "TIMEOUT"
    )


@row("A5", "Hub offline")
def test_the_guidance_without_weights_asks_no_network(tmp_path, monkeypatch, measured):
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    ended = launch(tmp_path, "trainer.max_steps=2")
    assert ended.code == 0, ended.err
    measured("a whole run without a socket")
