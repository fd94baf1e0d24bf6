"""The live viewer: training is the same with it, updates are bounded, and buttons are obeyed."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers.tiny_runs import assert_same_training
from tests.view.clouds import cloud
from threestudio_gaussiandreamer.launch import live_viewer
from threestudio_gaussiandreamer.launch.live_viewer import LiveViewer, ViewerConfig


class Watched:
    """A view that a browser looks at, without a server."""

    watched, address = True, "http://test"

    def __init__(self, *args):
        self.shown, self.cameras, self.pictures = [], 0, []

    def show(self, gaussians, status=""):
        self.shown.append((len(gaussians.means), status))

    def look_from_front(self, pose):
        pass

    def show_cameras(self, c2w, fovy, aspect):
        assert c2w.shape[1:] == (4, 4) and len(fovy) == len(c2w) and aspect == 1
        self.cameras += 1

    def close(self):
        self.closed = True


class Buttons:
    """Buttons without a panel; the score model's picture is asked for in every step."""

    pausing = False
    """Whether every step begins with a short pause."""

    def __init__(self, view):
        self.waited = False
        self.view, self.picture, self.paused = view, threading.Event(), False
        self.picture.set()
        self.cameras = SimpleNamespace(value=True)
        self.steps = 0

    def may_go_on(self):
        if not self.paused:
            self.waited = self.pausing and not self.waited
            return not self.waited
        self.steps -= 1
        return self.steps >= 0

    def show_picture(self, image):
        self.view.pictures.append(image)
        self.picture.set()

    def remove(self):
        self.removed = True


@pytest.fixture
def views(monkeypatch):
    """The views that runs open."""
    opened = []

    def open_view(*args):
        opened.append(Watched(*args))
        return opened[-1]

    monkeypatch.setattr("threestudio_gaussiandreamer.launch.run.LiveView", open_view)
    monkeypatch.setattr(live_viewer, "Controls", Buttons)
    return opened


def test_the_training_is_the_same_with_a_viewer(launch_demo, views, tmp_path, monkeypatch):
    monkeypatch.setattr(Buttons, "pausing", True)
    run = ["use_timestamp=false", "trainer.max_steps=4"]
    assert launch_demo(*run, "tag=off")[0] == 0
    shown = ["viewer.enabled=true", "viewer.updates_per_second=30", "viewer.keep_serving=false"]
    assert launch_demo(*run, *shown, "tag=on")[0] == 0
    (view,) = views
    assert view.shown[-1][1].startswith("step 4, ") and view.cameras > 0 and view.closed
    assert len(view.pictures) == 8 and view.pictures[0].dtype == np.uint8
    results = tmp_path / "outputs" / "demo"
    assert_same_training(results / "off/ckpts/last.ckpt", results / "on/ckpts/last.ckpt")


@pytest.fixture
def viewer():
    """A viewer at the start of a training, its trainer and its system."""
    made = LiveViewer(Watched(), ViewerConfig(updates_per_second=1), lambda: False)
    geometry = SimpleNamespace(**cloud(10).gaussians._asdict())
    trainer = SimpleNamespace(global_step=3, callback_metrics={"dB": 20.04})
    made.controls = Buttons(made.view)
    return made, trainer, SimpleNamespace(geometry=geometry)


def test_updates_take_at_most_their_share_of_the_time(viewer, monkeypatch):
    made, trainer, system = viewer
    now = SimpleNamespace(value=100.0)
    monkeypatch.setattr(live_viewer.time, "monotonic", lambda: now.value)

    def slow(gaussians, status=""):
        now.value += 0.5
        assert status == "step 3, 10 Gaussians, 20.0 dB"

    made.view.show = slow
    assert made._show_if_due(trainer, system)
    now.value = 100 + 0.5 / 0.02 - 0.01
    assert not made._show_if_due(trainer, system)
    now.value += 0.02
    assert made._show_if_due(trainer, system)


def test_nothing_is_read_without_a_browser_and_no_cameras_that_are_switched_off(viewer):
    made, trainer, system = viewer
    made.controls.cameras.value = False
    assert made._show_if_due(trainer, system, {}) and not made.view.cameras
    made.view.watched, made._due = False, 0.0
    del system.geometry
    assert not made._show_if_due(trainer, system)


def test_a_pause_ends_with_one_step_or_with_a_signal(viewer, monkeypatch):
    made, trainer, system = viewer
    waits = []
    monkeypatch.setattr(live_viewer.time, "sleep", waits.append)
    made.controls.picture.clear()
    made.controls.paused, made.controls.steps = True, 1
    made.on_train_batch_start(trainer, system, {}, 0)
    assert not waits
    made.stopping = lambda: len(waits) == 5
    made.on_train_batch_start(trainer, system, {}, 1)
    assert len(waits) == 5
