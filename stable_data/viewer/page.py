"""A page that shows scenes in a browser, without a network: each scene can be turned, beside it is what is known of it.

A page is one HTML file. The scenes are in it as binary glTF; only the one that is shown is decoded. The script that draws them is
in the page too, or beside it for several pages that share it. The page forbids the browser to load anything else.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError, SceneError, StableDataError, cannot_write, failure_line
from stable_data.export.glb import scene_glb
from stable_data.metrics.judge_columns import FURTHER, verdict_columns
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from stable_data.viewer.camera import ViewPoint, view_point
from stable_data.viewer.facts import AssetNotes, SceneFacts, breakable, style

SCRIPT_NAME = "model-viewer-umd.min.js"
"""File name of the script that draws the scenes, for pages that share it."""

MAX_PAGE_BYTES = 150 * 10**6
"""Largest page that is written; browsers need several times as much memory to open it."""


@dataclass(frozen=True, eq=False)
class PageScene:
    """A scene of a page.

    Attributes:
        title: Its name in the list of the page.
        glb: The scene as binary glTF.
        facts: What is shown beside it.
        view: Where the camera stands at first.
    """

    title: str
    glb: bytes
    facts: SceneFacts
    view: ViewPoint

    @classmethod
    def of(cls, geometry: SceneGeometry, facts: SceneFacts, title: str = "") -> "PageScene":
        """Makes a scene of a page; its title is its id if there is no other.

        Raises:
            ConfigError: A table of the run can no longer be read.
        """
        return cls(title or geometry.scene.scene_id, scene_glb(geometry), facts, view_point(geometry))


@cache
def script() -> bytes:
    """Returns the script that draws the scenes; a page without ``script_path`` contains it."""
    return files("stable_data.viewer").joinpath("model_viewer", SCRIPT_NAME).read_bytes()


def html_page(title: str, scenes: Sequence[PageScene], note: str = "", script_path: str | None = None) -> bytes:
    """Returns a page with scenes.

    Args:
        title: Title of the page.
        scenes: At least one scene; the page shows the first, or the one whose number its address ends with, such as ``#scene=1``.
        note: A line below the title.
        script_path: Address of the file :func:`script`, relative to the page; None: the page contains it.

    Raises:
        ConfigError: The page would have more than ``MAX_PAGE_BYTES`` (``page_too_big``).
    """
    _check_size(sum(len(scene.glb) for scene in scenes), len(scenes))
    listed = "".join(_entry(number, scene) for number, scene in enumerate(scenes))
    drawn = f"<script>{script().decode()}</script>" if script_path is None else f'<script src="{escape(script_path)}"></script>'
    text = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_allowed(script_path)}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style()}{_part('page.css')}</style></head>\n"
        f'<body class="{"several" if len(scenes) > 1 else "one"}">'
        f'<nav><h1>{escape(title)}</h1><p class="note">{escape(note)}</p><ol>{listed}</ol></nav>'
        '<main><model-viewer camera-controls touch-action="pan-y" interaction-prompt="none" shadow-intensity="0.6" '
        'shadow-softness="0.9" exposure="0.88" field-of-view="34deg" interpolation-decay="80" alt="The scene"></model-viewer>'
        '<p class="message" hidden></p><div class="tools"><button type="button" data-do="front">Front</button>'
        '<button type="button" data-do="top">Top</button><button type="button" data-do="turn" aria-pressed="false">Turn</button>'
        '<button type="button" data-do="labels" aria-pressed="false">Labels</button></div>'
        '<noscript><p class="message">The scene is drawn by JavaScript, which is off in this browser.</p></noscript></main>\n'
        f"<aside>{''.join(_article(number, scene) for number, scene in enumerate(scenes))}</aside>\n"
        f"{''.join(_model(number, scene) for number, scene in enumerate(scenes))}"
        f"{drawn}\n<script>{_part('page.js')}</script></body></html>\n"
    )
    return text.encode("utf-8", "replace")


def write_run_page(run: RunFolder, choice: SceneSelection, path: Path) -> list[str]:
    """Writes a page with scenes of a run, and returns a line for each scene that cannot be shown.

    Raises:
        ConfigError: A table is missing, no scene is selected, the page would be too big, or the file cannot be written.
        SceneError: No selected scene can be shown.
    """
    content, failures = run_page(run, choice)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file_atomically(path, content)
    except OSError as error:
        raise cannot_write(str(path), error) from error
    return failures


def run_page(run: RunFolder, choice: SceneSelection) -> tuple[bytes, list[str]]:
    """Returns a page with scenes of a run, and a line for each scene that cannot be shown; see :func:`write_run_page`."""
    scenes, notes = RunScenes(run, choice), AssetNotes(run)
    if not len(scenes):
        raise ConfigError(f"{run.uri}: no scene is selected, expected at least one; change the condition", "scene_unknown")
    shown, failures, size = list[PageScene](), list[str](), 0
    for row in scenes.rows():
        try:
            geometry = scenes.geometry(scene_from_row(row))
            shown.append(PageScene.of(geometry, SceneFacts.of(geometry, notes, row)))
        except StableDataError as error:
            if isinstance(error, ConfigError):
                raise  # the run cannot be read
            failures.append(failure_line(row["scene_id"], str(error)))
            continue
        except Exception as error:  # noqa: BLE001 - an unexpected error loses one scene only
            failures.append(failure_line(row["scene_id"], f"unexpected {type(error).__name__}: {error}; please report it"))
            continue
        size += len(shown[-1].glb)
        _check_size(size, len(shown))  # before all of them are in memory
    if not shown:
        raise SceneError(f"{run.uri}: no scene can be shown: {failures[0]}", "not_shown")
    name = run.root.rstrip("/").rpartition("/")[2]
    note = f"{len(shown)} of {run.num_rows('scenes')} scenes" + (f" where {choice.where}" if choice.where else "")
    return html_page(name or "scenes", shown, note), failures


def _check_size(num_bytes: int, num_scenes: int) -> None:
    whole = num_bytes * 4 // 3  # as base64
    if whole > MAX_PAGE_BYTES:
        raise ConfigError(
            f"a page with {num_scenes} scenes has {whole / 1e6:.0f} MB, expected at most {MAX_PAGE_BYTES / 1e6:.0f} MB; "
            "choose fewer scenes with --limit or --scene, or look at them with --live",
            "page_too_big",
        )


def _allowed(script_path: str | None) -> str:
    """What a browser may load for the page: what it contains, and the shared script."""
    shared = "" if script_path is None else " 'self' file:"
    return (
        f"default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'{shared}; style-src 'unsafe-inline'; "
        "img-src data: blob:; connect-src data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'"
    )


@cache
def _part(name: str) -> str:
    """A file of the page that is not made from data."""
    return files("stable_data.viewer").joinpath(name).read_text("utf-8")


def _entry(number: int, scene: PageScene) -> str:
    card, task = scene.facts.card or {}, scene.facts.scene.task
    verdicts = card.get("clean"), card.get("stable")
    further = {card.get(verdict_columns(name)[0]) for name in FURTHER}  # null where a judge was not asked
    is_bad = False in verdicts or False in further
    kind = "bad" if is_bad else "good" if verdicts == (True, True) else "unknown"
    said = "" if task is None else f"<small>{escape(task.task[:160])}</small>"
    return f'<li><a href="#scene={number}"><span class="dot {kind}"></span>{breakable(scene.title)}{said}</a></li>'


def _article(number: int, scene: PageScene) -> str:
    view, (x, y, z) = scene.view, scene.view.target
    at = " ".join(f"{value:.4f}" for value in (x, z, -y, view.distance, view.azimuth, view.polar))  # glTF has y up
    return (
        f'<article data-scene="{number}" data-view="{at}"{" hidden" if number else ""}>'
        f"<h2>{breakable(scene.title)}</h2>{scene.facts.html()}</article>\n"
    )


def _model(number: int, scene: PageScene) -> str:
    """The scene's file, as a block that the browser neither reads nor runs."""
    content = base64.b64encode(scene.glb).decode()
    return f'<script type="application/octet-stream" data-model="{number}">{content}</script>\n'
