"""A studio in a process of its own, and its page in headless Chromium."""

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.viewers.devtools import open_page

SECONDS = 300.0
"""Longest wait for anything, on a busy machine."""


class Tab:
    """The page of a studio, and what a person does there."""

    def __init__(self, page, address, root, process):
        self.page, self.address, self.root, self.process = page, address, root, process
        self.session = page.session

    def js(self, expression):
        self.page.session = self.session
        return self.page.evaluate(expression)

    def text(self, name):
        return self.js(f"document.getElementById('{name}').innerText")

    def press(self, name):
        self.js(f"document.getElementById('{name}').click()")

    def press_text(self, text):
        buttons = "[...document.querySelectorAll('#chosen button')]"
        self.js(f"{buttons}.find(button => button.textContent === '{text}').click()")

    def type(self, name, text):
        """Replace the text of a field as the keyboard does."""
        self.js(f"document.getElementById('{name}').focus()")
        self.js(f"document.getElementById('{name}').select()")
        self.page.call("Input.insertText", text=text)

    def start(self, prompt, choice="smoke.yaml", more="", keep="null", **fields):
        """Fill the form with any configuration, ``keep`` an uploaded file, and press Start."""
        self.js(f"document.getElementById('form').reset(), setFile({keep}), say('')")
        option = f"Object.assign(document.createElement('option'), {{value: '{choice}'}})"
        self.js(f"document.getElementById('choice').append({option})")
        self.js(f"document.getElementById('choice').value = '{choice}'")
        for name, text in {"prompt": prompt, "more": more, **fields}.items():
            field = f"document.getElementById('{name}')"
            self.js(f"{field}.closest('details')?.setAttribute('open', '')")
            self.type(name, text)
        jobs = "[state.job, state.last, ...state.queue].map(job => job ? job.id : 0)"
        before = self.js(f"Math.max(...{jobs})")
        self.press("start")
        self.until(f"Math.max(...{jobs}) > {before}")

    def until(self, condition):
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            if value := self.js(condition):
                return value
            time.sleep(0.1)
        raise AssertionError(f"{condition}: {self.js('JSON.stringify(state)')}")

    def until_ended(self):
        """Wait until no run is at work or waits; return the newest entry of the shelf."""
        self.until("state && !state.job && !state.queue.length")
        return self.newest()

    def newest(self):
        return json.loads(self.js("JSON.stringify(shelf[0] || null)"))

    def worker(self):
        children = subprocess.check_output(["pgrep", "-P", str(self.process.pid)], text=True)
        return int(children.split()[0])

    def other_tab(self):
        """Open the page in another tab of the same browser."""
        self.page.session = None
        self.page.load(self.address)
        return Tab(self.page, self.address, self.root, self.process)

    def to_front(self):
        """Show this tab, since one behind another gets no events of dialogs."""
        self.page.session = self.session
        self.page.call("Page.bringToFront")

    def reload(self):
        self.page.session = self.session
        self.page.call("Page.reload")
        time.sleep(0.5)
        self.until("document.readyState === 'complete' && state !== null")


@contextmanager
def opened(root: Path, size: tuple[int, int] = (1000, 600)) -> Iterator[Tab]:
    """Start a studio for the runs below ``root``, and open its page in a window of this size."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "threestudio_gaussiandreamer.studio", "--port", str(port)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    process = subprocess.Popen([*command, "--output", str(root)], **pipes)
    try:
        found = (re.search(r"http://\S+\d", line) for line in process.stdout)
        address = next(filter(None, found))[0] + "/"
        with open_page(address, size=size) as page:
            tab = Tab(page, address, root, process)
            tab.until("state !== null")
            yield tab
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(SECONDS) == 0
