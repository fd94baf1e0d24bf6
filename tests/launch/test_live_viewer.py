"""The live viewer: training is the same with it, updates are bounded, and buttons are obeyed."""

import threading
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from tests.helpers.gallery import assert_same_training
from tests.view.clouds import cloud
from threestudio_gaussiandreamer.launch import live_viewer


class Buttons:
    """Without a panel; each step asks for the picture, and begins with a pause if ``pausing``."""

    pausing = paused = waited = False
    steps = 0

    def __init__(self, view):
        self.view, self.picture = view, threading.Event()
        self.picture.set()
        self.cameras = SimpleNamespace(value=True)

    def may_go_on(self):
        if not self.paused:
            self.waited = self.pausing and not self.waited
            return not self.waited
        self.steps -= 1
        return self.steps >= 0

    def show_picture(self, image):
        self.view.pictures.append(image)
        self.picture.set()

    def remove(self): ...


@pytest.fixture
def view(monkeypatch):
    """A view that a browser looks at, without a server, for a run."""
    view = Mock(watched=True, address="http://test", pictures=[])
    monkeypatch.setattr("threestudio_gaussiandreamer.launch.run.LiveView", lambda *args: view)
    monkeypatch.setattr(live_viewer, "Controls", Buttons)
    return view


def test_the_training_is_the_same_with_a_viewer(launch_demo, view, tmp_path, monkeypatch):
    monkeypatch.setattr(Buttons, "pausing", True)
    run = ["use_timestamp=false", "trainer.max_steps=4"]
    assert launch_demo(*run, "tag=off")[0] == 0
    monkeypatch.setattr(live_viewer, "SECONDS_BETWEEN", 0.0)
    monkeypatch.setattr(live_viewer, "SHARE_OF_TIME", float("inf"))  # also if all is slow
    shown = ["viewer.enabled=true", "viewer.updates_per_second=30", "viewer.keep_serving=false"]
    code, err = launch_demo(*run, *shown, "tag=on")
    assert code == 0 and "viewer.updates_per_second is no option any more" in err
    assert view.show.call_args.args[1].startswith("step 4, ") and view.close.called
    c2w, fovy, aspect = view.show_cameras.call_args.args
    assert c2w.shape[1:] == (4, 4) and len(fovy) == len(c2w) and aspect == 1
    assert len(view.pictures) == 8 and view.pictures[0].dtype == np.uint8
    results = tmp_path / "outputs" / "demo"
    assert_same_training(results / "off/ckpts/last.ckpt", results / "on/ckpts/last.ckpt")


@pytest.fixture
def viewer(monkeypatch):
    """A viewer at the start of a training, its trainer, its system and a clock."""
    made = live_viewer.LiveViewer(Mock(watched=True), lambda: False)
    geometry = SimpleNamespace(**cloud(10).gaussians._asdict())
    trainer = SimpleNamespace(global_step=3, callback_metrics={"dB": 20.04})
    made.controls = Buttons(made.view)
    made.controls.picture.clear()
    made.controls.cameras.value = False
    now = SimpleNamespace(value=100.0)
    monkeypatch.setattr(live_viewer.time, "monotonic", lambda: now.value)
    return made, trainer, SimpleNamespace(geometry=geometry), now


def test_updates_take_at_most_their_share_of_the_time(viewer):
    made, trainer, system, now = viewer
    shown = []

    def slow(gaussians, status=""):
        now.value += 0.5
        shown.append(status)

    made.view.show = slow
    for later in (0.0, 0.5 / 0.02 - 0.51, 0.02):
        now.value += later
        made.on_train_batch_end(trainer, system, None, {})
    assert shown == ["step 3, 10 Gaussians, 20.0 dB"] * 2 and not made.view.show_cameras.called


def test_a_pause_ends_with_a_step_or_a_signal_and_reads_nothing_unwatched(viewer, monkeypatch):
    made, trainer, system, _ = viewer
    waits = []
    monkeypatch.setattr(live_viewer.time, "sleep", waits.append)
    made.view.watched = False
    del system.geometry
    made.controls.paused, made.controls.steps = True, 1
    made.on_train_batch_start(trainer, system, {}, 0)
    assert not waits
    made.stopping = lambda: len(waits) == 5
    made.on_train_batch_start(trainer, system, {}, 1)
    assert len(waits) == 5
