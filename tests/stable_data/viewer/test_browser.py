"""The page in a browser: it draws the scene, loads nothing and complains about nothing."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import pytest

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
    *(
        "--window-size=320,240",
        "--virtual-time-budget=6000",
        "--enable-logging=stderr",
        "--host-resolver-rules=MAP * ~NOTFOUND",
    ),
)
WATCH = """<script>
const refused = [], errors = [];
addEventListener("securitypolicyviolation", (event) => refused.push(event.blockedURI + " " + event.violatedDirective));
addEventListener("error", (event) => errors.push(String(event.message)));
addEventListener("unhandledrejection", (event) => errors.push(String(event.reason)));
console.error = (...words) => errors.push(words.join(" "));
addEventListener("load", () => document.querySelector("model-viewer").addEventListener("load", () => {
  const names = performance.getEntriesByType("resource").map((entry) => entry.name);
  document.body.dataset.seen = JSON.stringify([names, refused, errors, document.querySelector("model-viewer").loaded]);
}));
</script><title>"""
"""It notes what the page loads and what goes wrong, from the start; what the page says to developers alone is no error."""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")


def test_a_browser_draws_the_scene_and_loads_nothing(viewed_run: RunFolder, tmp_path: Path) -> None:
    geometry = SceneGeometry.of(hostile(), run_store(viewed_run.uri))
    scene = PageScene.of(geometry, SceneFacts.of(geometry, AssetNotes(viewed_run)))
    path = tmp_path / "scenes" / "page.html"
    path.parent.mkdir()
    (tmp_path / SCRIPT_NAME).write_bytes(script())
    path.write_text(html_page("page", [scene], script_path=f"../{SCRIPT_NAME}").decode().replace("<title>", WATCH), "utf-8")
    command = [str(CHROMIUM), *OPTIONS, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    body = re.search(r"<body[^>]*>", done.stdout)
    assert body is not None
    assert 'data-loaded="0"' in body[0], done.stderr[-2000:]
    seen = re.search(r'data-seen="([^"]*)"', body[0])
    assert seen is not None
    names, refused, errors, is_loaded = json.loads(unescape(seen[1]))
    assert is_loaded
    assert refused == []
    assert errors == []
    assert [name for name in names if not name.startswith(("file:", "blob:", "data:"))] == []
    assert done.stdout.count('class="label"') == len(geometry.scene.objects)
