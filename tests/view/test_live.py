"""The server of a cloud: what viser gets, what a browser shows, and messages for wrong input."""

import socket
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers.refusals import refused
from tests.view.clouds import cloud
from threestudio_gaussiandreamer.formats.gaussian_files import write_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.view import command, live


@pytest.fixture
def port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def taken():
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield server.getsockname()[1]


def test_what_viser_gets_and_the_buttons_of_a_training():
    quarter_turn = np.float32([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])  # about z: x becomes y
    one = Gaussians(
        means=np.float32([[1, 2, 3]]),
        sh=np.float32([[[0, 10, -10]]]),
        logit_opacities=np.float32([0]),
        log_scales=np.log(np.float32([[1, 2, 3]])),
        quats=quarter_turn,
    )
    got = live.splats(one)
    np.testing.assert_allclose(got["covariances"][0], np.diag([4, 1, 9]), atol=1e-6)
    np.testing.assert_allclose(got["rgbs"], [[0.5, 1, 0]])
    assert got["opacities"].shape == (1, 1) and got["opacities"][0, 0] == 0.5
    actions, removed = {}, []

    def add(label, value=None):
        pressed = partial(actions.__setitem__, label)
        named = dict.fromkeys(("on_click", "on_update"), pressed)
        return SimpleNamespace(value=value, remove=lambda: removed.append(label), **named)

    server = SimpleNamespace(gui=SimpleNamespace(add_button=add, add_checkbox=add))
    view = SimpleNamespace(server=server, remove_cameras=lambda: removed.append("cameras"))
    controls = live.Controls(view)
    actions["Training cameras"](None)
    assert controls.cameras.value and not removed
    controls.cameras.value = False
    actions["Training cameras"](None)
    assert removed == ["cameras"]
    allowed = []
    for pressed in ("One step", "Pause", "One step", "Pause"):
        actions[pressed](None)
        allowed += [controls.may_go_on(), controls.may_go_on()]
    assert allowed == [True, True, False, False, True, False, True, True]
    controls.remove()
    assert removed.count("cameras") == 2 and {*actions} < {*removed}


@pytest.fixture(scope="module")
def view():
    pytest.importorskip("viser")
    view = live.LiveView("127.0.0.1", 0, "<img src=x onerror=hurt()>\n# [a](b) **cloud**")
    yield view
    view.close()


def handshake(port, **headers):
    """Return the status of the answer to a WebSocket's opening request with ``headers``."""
    known = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    known["Sec-WebSocket-Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
    known["Sec-WebSocket-Protocol"] = f"viser-v{pytest.importorskip('viser').__version__}"
    lines = ["GET / HTTP/1.1", *(f"{name}: {x}" for name, x in (headers | known).items())]
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(connection.recv(4096).split()[1])


def test_only_the_servers_own_page_is_answered_and_updates_replace_the_cloud(view):
    port = view.server.get_port()
    assert view.address == f"http://127.0.0.1:{port}"
    own, local = f"127.0.0.1:{port}", f"localhost:{port}"
    for site in (own, local, "localhost:9000", f"[::1]:{port}", f"{socket.gethostname()}:1"):
        assert handshake(port, Host=site, Origin=f"http://{site}") == 101, site
    assert handshake(port, Host=own) == 101  # no browser
    for origin in ("https://evil.example", "null", f"http://127.0.0.1:{port + 1}", ""):
        assert handshake(port, Host=own, Origin=origin) == 403, origin
    # DNS rebinding: the name of another site leads here
    rebound = f"evil.example:{port}"
    assert handshake(port, Host=rebound, Origin=f"http://{rebound}") == 403
    assert handshake(port, Host=rebound) == 403
    assert handshake(port, Host=f"127.0.0.1.evil.example:{port}") == 403
    assert handshake(port, Host=f"evil.example@127.0.0.1:{port}", Origin="http://a") == 403
    for count in (5, 5, 7):
        view.show(cloud(count).gaussians, f"{count} Gaussians")
        assert len(view._splats.centers) == count
        title, _, status = view._status.content.partition("\n\n")
        assert title == r"**\<img src\=x onerror\=hurt\(\)\> \# \[a\]\(b\) \*\*cloud\*\***"
        assert status == f"{count} Gaussians"
    for views in (2, 2, 3):
        poses = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
        poses[:, 0, 3] = views
        view.show_cameras(poses, np.full(views, 0.5, np.float32), 1.5)
        assert [frustum.position[0] for frustum in view._frustums] == [views] * views
        assert view._frustums[0].fov == 0.5 and view._frustums[0].aspect == 1.5
    view.remove_cameras()
    assert not view._frustums and not view.watched


def test_a_server_that_cannot_be_guarded_is_not_used(monkeypatch):
    stopped = []
    server = SimpleNamespace(stop=lambda: stopped.append(1))
    monkeypatch.setattr(pytest.importorskip("viser"), "ViserServer", lambda **_: server)
    refused("this version of viser", live.LiveView, "127.0.0.1", 0, "cloud")
    assert stopped
    assert live.is_own_page("gpu7.lab:80", "http://gpu7.lab:80", "gpu7.lab")
    assert live.is_own_page("192.168.0.7:80", "https://192.168.0.7:80", "0.0.0.0")
    assert not live.is_own_page("gpu8.lab:80", "http://gpu8.lab:80", "gpu7.lab")
    assert not live.is_own_page(None, None, "0.0.0.0")


def test_without_viser_the_extra_is_named(monkeypatch, port):
    monkeypatch.setitem(sys.modules, "viser", None)
    refused(r"\[viewer\]", live.require_server, "127.0.0.1", port)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}/runs"], "no run with an exported cloud"),
        (["{}/text.ply"], "text.ply"),
        (["{}/empty.ply"], "empty.ply has no Gaussians that can be drawn"),
        (["{}/far.ply"], "further than"),
        (["{}/a.ply", "--eps2d", "0.3"], "--eps2d: is for the page"),
        (["{}/a.ply", "--port", "{taken}"], "can't be served (Address already in use)"),
        (["{}/a.ply", "--port", "65536"], "127.0.0.1:65536 can't be served"),
        (["{}/a.ply", "--host", "é" * 70], "choose another port"),
        (["{}/a.ply", "--host", "\0"], "choose another port"),
    ],
)
def test_wrong_input_is_named_before_serving(tmp_path, capsys, port, taken, arguments, message):
    pytest.importorskip("viser")
    write_cloud(str(tmp_path / "a.ply"), cloud(5))
    write_cloud(str(tmp_path / "empty.ply"), cloud(0))
    far = cloud(5)
    far.gaussians.means[:] *= 1e20
    write_cloud(str(tmp_path / "far.ply"), far)
    (tmp_path / "runs").mkdir()
    (tmp_path / "text.ply").write_text("hello")
    arguments = [x.replace("{}", str(tmp_path)) for x in arguments]
    arguments = [x.replace("{taken}", str(taken)) for x in arguments]
    assert command.main(["--port", str(port), *arguments]) == 2
    assert message in capsys.readouterr().err
