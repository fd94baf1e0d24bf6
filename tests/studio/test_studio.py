"""The studio in headless Chromium: what a person does there, and what goes wrong."""

import json
import os
import re
import resource
import signal
import socket
import time
import urllib.request

import pytest

from tests.view.test_live import handshake
from threestudio_gaussiandreamer.launch import config, experiment, options
from threestudio_gaussiandreamer.studio.server import WEB

HOSTILE = (
    '<img src=x onerror="window.hurt=1"> & <script>window.hurt=1</script> **лиса** 狐 ' + "x" * 4000
)
LONG = "trainer.max_steps=100000 data.n_test_views=1"
PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}


def fetched(studio, path) -> bytes:
    with urllib.request.urlopen(studio.address + "files/" + urllib.request.quote(path)) as answer:
        return answer.read()


def file_of(entry, name) -> str:
    return next(file["path"] for file in entry["files"] if file["name"] == name)


@pytest.fixture(scope="module")
def made(studio):
    """The entry of a finished run with a hostile prompt."""
    studio.start(HOSTILE, steps="6", seed="3")
    studio.until("state.counts.main > 0")
    return studio.until_ended()


def test_a_prompt_is_text_and_the_ply_is_that_of_the_command_line(studio, made, tmp_path):
    assert made["prompt"] == HOSTILE and made["ended"]
    assert studio.js("window.hurt === undefined && !document.querySelector('main img[onerror]')")
    assert HOSTILE[:100] in studio.text("cards")
    argv = ["--config", "smoke.yaml", "--train", f"exp_root_dir={tmp_path}", "trainer.max_steps=6"]
    assert experiment.main([*argv, "seed=3", f"system.prompt_processor.prompt={HOSTILE}"]) == 0
    (own,) = tmp_path.glob("smoke/*/save/it6-export/gaussians.ply")
    assert fetched(studio, file_of(made, "gaussians.ply")) == own.read_bytes()
    module = "threestudio_gaussiandreamer.launch.experiment"
    assert made["command"].split()[1:4] == ["-m", module, "--config"]
    assert "files/" in studio.js("document.querySelector('.card img').src")


def test_no_request_leaves_the_machine_and_nothing_is_wrong(studio, made):
    found = [x for x in studio.page.requests if not x.startswith(("data:", "blob:"))]
    assert found and all(x.startswith(studio.address) for x in found)
    refused = [x for x in studio.page.problems if "Content Security Policy" in x or "Uncaught" in x]
    assert not refused


def test_a_run_is_compared_pruned_taken_away_and_repeated(studio, made):
    studio.js("choose(shelf[0])")
    studio.press_text("Make gaussians.sog")
    studio.until("shelf[0].files.some(file => file.name === 'gaussians.sog')")
    studio.js("choose(shelf[0])")
    studio.js("document.querySelector('[aria-label=Budget]').value = 'count'")
    studio.js("document.querySelector('[aria-label=\"Value of the budget\"]').value = '100'")
    studio.press_text("Prune to")
    studio.until("state.counts.beside === 100 && state.counts.main > 100")
    studio.press_text("Again with this changed")
    fields = "['prompt', 'steps', 'seed', 'choice', 'more'].map(id => [id, $(id).value])"
    form = json.loads(studio.js(f"JSON.stringify(Object.fromEntries({fields}))"))
    given = {"prompt": HOSTILE, "steps": "6", "seed": "3"}
    assert form == given | {"choice": "smoke.yaml", "more": ""}
    assert fetched(studio, file_of(studio.newest(), "parsed.yaml"))
    page = file_of(made, "view.html")
    with urllib.request.urlopen(studio.address + "files/" + urllib.request.quote(page)) as answer:
        assert "sandbox" in answer.headers["Content-Security-Policy"]


def test_a_long_run_survives_reloads_and_tabs_and_its_death_leaves_the_studio(studio):
    studio.start("a ball", more=LONG)
    studio.until("state.job && state.job.status.step > 0")
    studio.start("\n".join(f"prompt {i}" for i in range(200)))
    studio.until("state.queue.length === 200 && $('queue').children.length === 200")
    studio.js("document.querySelector('#queue button').click()")
    studio.until("state.queue.length === 199")
    other = studio.other_tab()
    other.until("state && state.queue.length === 199 && state.job.status.step > 0")
    other.press("clear")
    studio.until("state.queue.length === 0")
    studio.press("pause")
    other.until("state.job.paused && $('pause').textContent === 'Go on'")
    time.sleep(0.5)
    step = other.js("state.job.status.step")
    studio.to_front()
    studio.reload()
    assert studio.js("state.job.status.step") == step
    studio.press("pause")
    studio.until(f"state.job.status.step > {step}")
    os.kill(studio.worker(), signal.SIGKILL)
    studio.until("$('message').textContent.includes('signal 9')")
    assert studio.process.poll() is None


def test_stop_writes_a_checkpoint_from_which_the_run_goes_on(studio):
    studio.start("a cube", more="trainer.max_steps=200 data.n_test_views=1")
    studio.until("state.job && state.job.status.step > 0")
    studio.press("stop")
    stopped = studio.until_ended()
    assert not stopped["ended"] and stopped["resume"]
    studio.js("choose(shelf[0])")
    studio.press_text("Go on from its checkpoint")
    studio.until("state.job")
    resumed = studio.until_ended()
    assert resumed["id"] == stopped["id"] and resumed["ended"]
    assert any("it200" in file["path"] for file in resumed["files"])


def test_every_choice_of_the_page_is_a_whole_configuration():
    choices = re.findall(r'option value="([^"]+)"', (WEB / "studio.html").read_text())
    assert len(choices) == 9
    prompt = ["system.prompt_processor.prompt=a fox"]
    for choice in choices:
        cfg = config.load_config(*map(options.find_config, choice.split()), cli_args=prompt)
        assert cfg.system_type and cfg.data_type and cfg.trainer["max_steps"] > 0, choice


def test_wrong_requests_and_damaged_runs_leave_the_page_alive(studio):
    damaged = studio.root / "smoke" / "damaged"
    for name in ("configs", "save/it5-export"):
        (damaged / name).mkdir(parents=True)
    (damaged / "configs/parsed.yaml").write_text("system: [")
    (damaged / "save/metrics.json").write_text('{"result": {"psnr": "none"}}')
    (damaged / "save/it5-export/lost.ply").symlink_to("nowhere")
    (damaged / os.fsdecode(b"save/it5-export/\xff.spz")).touch()
    studio.js("ask({do: 'refresh'})")
    studio.until("$('cards').innerText.includes('damaged')")
    studio.js("choose(shelf.find(run => run.id === 'smoke/damaged'))")
    for wrong in ([], 5, {}, {"do": "root"}, {"do": "start", "words": 5, "label": ""}, {"do": "x"}):
        studio.js(f"ask({json.dumps(wrong)})")
        studio.until("$('message').textContent !== ''")
    assert studio.js("$('steps').placeholder") == "150"
    studio.start("a first ball", more="trainer.max_stepz=3")
    studio.js("ask({do: 'start', words: [5, {}, '\\u0000'], label: {a: 1}})")
    studio.until("$('message').textContent.includes('null byte')")
    studio.js(f"ask({{do: 'delete', run: {json.dumps('smoke/damaged')}}})")
    studio.until("!$('cards').innerText.includes('damaged')")


def test_errors_are_those_of_the_command_line(studio, capfd):
    argv = ["--config", "smoke.yaml", "--train", "trainer.max_stepz=3"]
    assert experiment.main(argv) == 2
    expected = capfd.readouterr().err.split("error: ")[1].strip()
    studio.start("a ball", more="trainer.max_stepz=3")
    studio.until("$('message').textContent.includes('error:')")
    assert expected in studio.text("message")


@pytest.mark.slow
def test_a_full_disk_is_told_and_ends_the_run_only(studio):
    """A limit of the size of files, which the run's process inherits, stands for the disk."""
    _, most = resource.prlimit(studio.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(studio.process.pid, resource.RLIMIT_FSIZE, (20_000, most))
    try:
        studio.start("a cone", more="data.n_test_views=1")
        studio.until("$('message').textContent.includes('error:')")
        assert "File too large" in studio.text("message")
    finally:
        resource.prlimit(studio.process.pid, resource.RLIMIT_FSIZE, (most, most))
    assert studio.process.poll() is None


def test_deleting_asks_first_and_deletes_runs_only(studio, made):
    folder = studio.root / made["id"]
    studio.js(f"choose(shelf.find(run => run.id === {json.dumps(made['id'])}))")
    studio.press_text("Delete ...")
    studio.js("document.querySelector('#ask button[value=no]').click()")
    assert folder.is_dir()
    for name in ("..", ".", "smoke", "../outputs", "/etc"):
        studio.js(f"ask({{do: 'delete', run: '{name}'}})")
        studio.until("$('message').textContent !== ''")
    assert folder.is_dir()
    studio.press_text("Delete ...")
    studio.js("document.querySelector('#ask button[value=yes]').click()")
    studio.until(f"!shelf.some(run => run.id === {json.dumps(made['id'])})")
    assert not folder.exists()


def test_the_sockets_and_pages_refuse_other_sites(studio):
    port = int(studio.address.rstrip("/").rpartition(":")[2])
    own = f"127.0.0.1:{port}"
    assert handshake(port, Host=own, Origin=f"http://{own}") == 101
    for origin in ("https://evil.example", "null", f"http://127.0.0.1:{port + 1}"):
        assert handshake(port, Host=own, Origin=origin) == 403
    assert handshake(port, Host=f"evil.example:{port}") == 403
    for path in ("files/../secret", "files/%2e%2e/x", "files//etc/passwd", "etc/passwd"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(studio.address + path)
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.sendall(f"GET / HTTP/1.1\r\nHost: evil.example:{port}\r\n\r\n".encode())
        assert connection.recv(4096).split()[1] == b"403"


def test_a_phone_a_keyboard_and_the_dark(studio):
    page = studio.page
    page.session = studio.session
    try:
        page.call("Emulation.setDeviceMetricsOverride", **PHONE)
        features = [{"name": "prefers-color-scheme", "value": "dark"}]
        page.call("Emulation.setEmulatedMedia", features=features)
        studio.reload()
        assert studio.js("document.documentElement.scrollWidth <= innerWidth")
        assert studio.js("$('start').getBoundingClientRect().height >= 44")
        assert studio.js("getComputedStyle(document.body).backgroundColor") == "rgb(21, 21, 21)"
        assert studio.js("$('scene').src").endswith("?darkMode")
        studio.js("$('prompt').focus()")
        reached = []
        for _ in range(20):
            for kind in ("keyDown", "keyUp"):
                key = {"key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9}
                page.call("Input.dispatchKeyEvent", type=kind, **key)
            reached.append(studio.js("document.activeElement.id"))
        assert {"choice", "upload", "steps", "count", "start", "refresh"} <= set(reached)
    finally:
        page.call("Emulation.clearDeviceMetricsOverride")
        page.call("Emulation.setEmulatedMedia", features=[])
