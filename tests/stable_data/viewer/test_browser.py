"""The page in a browser: it draws the scene, loads nothing and complains about nothing."""

import json
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from stable_data.assets.run_assets import run_store
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.viewer.facts import AssetNotes, SceneFacts
from stable_data.viewer.page import SCRIPT_NAME, PageScene, html_page, script
from tests.stable_data.viewer.conftest import hostile

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
OPTIONS = (
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ),
    *("--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--window-size=320,240", "--remote-debugging-port=0", "--host-resolver-rules=MAP * ~NOTFOUND"),
)
SECONDS = 120  # for a busy machine without a GPU

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")


class Tab:
    """A tab of a browser, by the protocol of its developer tools.

    Attributes:
        requests: The addresses that its page asked for.
        errors: What its page wrote as an error, threw, or was refused.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection, self._last = connection, 0
        self.requests, self.errors = list[str](), list[str]()
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._last += 1
        self._connection.send(json.dumps({"id": self._last, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._connection.recv(timeout=SECONDS))
            if message.get("id") == self._last:
                return dict(message["result"])
            self._note(message.get("method", ""), message.get("params", {}))

    def _note(self, method: str, found: dict[str, Any]) -> None:
        if method == "Network.requestWillBeSent":
            self.requests.append(found["request"]["url"])
        elif method == "Runtime.exceptionThrown" or (method == "Runtime.consoleAPICalled" and found["type"] == "error"):
            self.errors.append(json.dumps(found))
        elif method == "Log.entryAdded" and found["entry"]["level"] == "error":
            self.errors.append(found["entry"]["text"])

    def value(self, expression: str) -> Any:
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression: str) -> None:
        end = time.monotonic() + SECONDS
        while not self.value(expression):
            assert time.monotonic() < end, f"not true: {expression}; {self.errors}"
            time.sleep(0.1)


@contextmanager
def browser_tab(profile: Path) -> Iterator[Tab]:
    """An empty tab of a browser of its own."""
    command = [str(CHROMIUM), *OPTIONS, f"--user-data-dir={profile}", "about:blank"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as browser:
        try:
            assert browser.stderr is not None
            port = next(
                found[1] for line in browser.stderr if (found := re.search(r"DevTools listening on ws://[^:]*:(\d+)", line))
            )
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=SECONDS) as answer:
                [address] = [target["webSocketDebuggerUrl"] for target in json.load(answer) if target["type"] == "page"]
            with connect(address, max_size=None) as connection:
                yield Tab(connection)
        finally:
            browser.terminate()


def test_a_browser_draws_the_scene_and_loads_nothing(viewed_run: RunFolder, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(hostile(), run_store(viewed_run.uri))
    scene = PageScene.of(geometry, SceneFacts.of(geometry, AssetNotes(viewed_run)))
    path = tmp_path / "scenes" / "page.html"
    path.parent.mkdir()
    (tmp_path / SCRIPT_NAME).write_bytes(script())
    path.write_bytes(html_page("page", [scene], script_path=f"../{SCRIPT_NAME}"))
    with browser_tab(tmp_path / "profile") as tab:
        tab.call("Page.navigate", url=path.as_uri())
        tab.wait_for("document.body?.dataset.loaded === '0'")
        assert tab.value("document.querySelector('model-viewer').loaded")
        assert tab.value("document.querySelectorAll('.label').length") == len(geometry.scene.objects)
        assert tab.value("document.querySelector('.message').hidden")
        assert tab.errors == []
        files = [path.as_uri(), (tmp_path / SCRIPT_NAME).as_uri()]
        assert [name for name in tab.requests if not name.startswith(("blob:", "data:"))] == files
        tab.value("fetch('https://example.org/x').catch(() => 0); console.error('noted')")
        tab.wait_for("true")
        assert any("Content Security Policy" in error for error in tab.errors)  # so the page could not have loaded anything
        assert any("noted" in error for error in tab.errors)
