"""The live viewer: pages through the scenes of a run in a browser, filters them, shows colliders and steps the physics.

Scenes are read when they are shown; a browser gets one scene at a time. All windows on one viewer show the same scene.
"""

import errno
import io
import math
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, redirect_stdout
from html import escape
from types import TracebackType
from typing import Any

import numpy as np
import viser

from stable_data.errors import ConfigError, SceneError, StableDataError
from stable_data.export.glb import object_glb, surfaces_glb, table_glb
from stable_data.geometry.surface import Surface
from stable_data.json_text import quote_value
from stable_data.rotations import wxyz, yaw_quat
from stable_data.scene import Stage
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import scene_from_row
from stable_data.viewer.camera import view_point
from stable_data.viewer.earlier_poses import EarlierPoses
from stable_data.viewer.facts import AssetNotes, SceneFacts, breakable, style
from stable_data.viewer.physics import ScenePhysics

AFTER, BEFORE = "as in the scene", "before the correction"
"""The poses that can be shown."""

_STAGES = {Stage.TASK: "Task objects (O^t)", Stage.IMPORTANT: "Important (O^B)", Stage.SECONDARY: "Secondary (O^b)"}
_PARTS = (
    (0.90, 0.35, 0.25),
    (0.20, 0.55, 0.85),
    (0.95, 0.75, 0.20),
    (0.30, 0.70, 0.40),
    (0.65, 0.40, 0.80),
    (0.95, 0.55, 0.15),
)
_TICK = 1 / 30  # seconds between two updates of the poses in the browser
_LONGEST_TICK = 0.1  # simulated in one update, seconds: on a slow machine the physics go slower, and the page still answers
_STEPS = 10  # of the button Step
_FIELD_OF_VIEW = math.radians(36)
_NEAR = 0.05  # nearest distance that is drawn, metres
_SKY = ((246, 248, 250), (222, 227, 234))  # colours at the upper and the lower edge of the picture
_LABEL = 40  # characters of a label


class LiveViewer:
    """A server with the scenes of a run, for browsers.

    Args:
        run: The run.
        choice: The selection of its scenes, which the viewer can narrow further; None: all.
        host: Address of this machine at which the server listens.
        port: Port of the server; 0: any free one.

    Attributes:
        server: The viser server.
        nodes: The node of each object of the shown scene, in its order: at the centre of its box, turned by its yaw.

    Raises:
        ConfigError: The run cannot be read, no scene is selected, or the port cannot be used (``port_in_use``).
    """

    def __init__(self, run: RunFolder, choice: SceneSelection | None = None, host: str = "127.0.0.1", port: int = 0) -> None:
        self._run, self._choice = run, choice or SceneSelection()
        self._scenes = RunScenes(run, self._choice)
        if not len(self._scenes):
            raise ConfigError(f"{run.uri}: no scene is selected, expected at least one; change the condition", "scene_unknown")
        self._notes, self._earlier = AssetNotes(run), EarlierPoses(run)
        self._lock = threading.RLock()
        self._number, self._row, self._is_before = -1, Row(), False
        self._text, self._acting = "", False
        self._has_parts, self._has_labels, self._hidden = False, False, frozenset[Stage]()
        self._geometry: SceneGeometry | None = None
        self._physics: ScenePhysics | None = None
        self._playing, self._ended = threading.Event(), threading.Event()
        self._root: viser.FrameHandle | None = None
        self._looks: list[viser.SceneNodeHandle] = []
        self._parts: list[viser.SceneNodeHandle] = []
        self._labels: list[viser.SceneNodeHandle] = []
        self.nodes: list[viser.FrameHandle] = []
        self.server = _start(host, port)
        self._build_panel()
        self.show(0)
        self._thread = threading.Thread(target=self._play, name="physics", daemon=True)
        self._thread.start()

    def __enter__(self) -> "LiveViewer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    @property
    def port(self) -> int:
        """The port at which the server listens."""
        return int(self.server.get_port())

    @property
    def number(self) -> int:
        """The number of the shown scene among the selected ones, from 0."""
        return self._number

    @property
    def num_scenes(self) -> int:
        """How many scenes are selected."""
        return len(self._scenes)

    @property
    def message(self) -> str:
        """What the page tells the user: one line; empty if nothing is wrong."""
        return self._text

    @property
    def num_parts(self) -> int:
        """For how many objects the colliders are drawn; none before they are asked for."""
        return len(self._parts)

    @property
    def geometry(self) -> SceneGeometry | None:
        """The scene that is shown; None if it cannot be shown."""
        return self._geometry

    def stop(self) -> None:
        """Ends the server."""
        self._ended.set()
        self._playing.set()
        self._thread.join(timeout=5)
        with redirect_stdout(io.StringIO()):  # it prints that it ended
            self.server.stop()

    # --- which scene --------------------------------------------------------------------------------------------------------

    def show(self, number: int) -> None:
        """Shows a scene by its number, from 0; beyond the last one the first, and the other way round."""
        with self._telling():
            self._number = number % len(self._scenes)
            self._row = self._scenes.row(self._number)
            self._rebuild()

    def go_to(self, name: str) -> None:
        """Shows a scene by its id, or by its number, from 1."""
        with self._telling():
            name = name.strip()
            number = int(name) - 1 if name.isdecimal() and len(name) < 12 else self._scenes.number_of(name)
            self._scenes.row(number)  # refuses a number that does not exist; the shown scene stays
            self.show(number)

    def filter(self, condition: str) -> None:
        """Narrows the selection of scenes by a condition; an empty one selects all again.

        A condition that cannot be used, or that no scene satisfies, changes nothing; the page tells what is wrong.
        """
        with self._telling():
            condition = condition.strip()
            if condition:
                parse_filter(condition, SCHEMAS["scenes"])  # alone first, so that an error quotes the user's text only
            ids = f"scene_id in {sorted(self._choice.scene_ids)!r}" if self._choice.scene_ids else None
            parts = [f"({part})" for part in (self._choice.where, ids, condition) if part]
            choice = SceneSelection(" and ".join(parts) or None, limit=self._choice.limit)
            found = self._scenes.select(choice)
            if not len(found):
                raise ConfigError(f"no scene satisfies {quote_value(condition)}; the shown scenes stay", "scene_unknown")
            self._scenes = found
            self.show(0)

    def set_poses(self, poses: str) -> None:
        """Shows the scene as it is (``AFTER``) or as it was before the correction (``BEFORE``)."""
        with self._telling():
            self._is_before = poses == BEFORE
            self._rebuild(keep_camera=True)

    # --- physics --------------------------------------------------------------------------------------------------------------

    def play(self) -> None:
        """Lets the physics run, about as fast as a clock where the machine is fast enough."""
        with self._telling():
            self._simulated()
            self._playing.set()
            self._tell_time()

    def pause(self) -> None:
        """Stops the physics."""
        with self._telling():
            self._playing.clear()
            self._tell_time()

    def step(self, num_steps: int = _STEPS) -> None:
        """Simulates some steps of the verdict's length."""
        with self._telling():
            physics = self._simulated()
            physics.step(num_steps)
            self._move(physics)

    def reset(self) -> None:
        """Puts the objects back and stops the physics."""
        with self._telling():
            self._playing.clear()
            if self._physics is not None:
                self._physics.reset()
                self._move(self._physics)

    def _simulated(self) -> ScenePhysics:
        if self._geometry is None:
            raise SceneError("no scene is shown, so there is nothing to simulate; go to another scene", "not_shown")
        if self._physics is None:
            self._physics = ScenePhysics(self._geometry)
        return self._physics

    def _play(self) -> None:
        """Steps the physics while they run; the thread of the viewer."""
        last = time.monotonic()
        while not self._ended.is_set():
            if not self._playing.wait(timeout=0.5):
                last = time.monotonic()
                continue
            now = time.monotonic()
            with self._telling():
                if self._playing.is_set() and self._physics is not None:
                    elapsed = min(now - last, _LONGEST_TICK)
                    self._physics.step(max(1, round(elapsed / self._physics.timestep)))
                    self._move(self._physics)
            last = now
            time.sleep(max(0.0, _TICK - (time.monotonic() - now)))

    def _move(self, physics: ScenePhysics) -> None:
        """Puts the nodes where the objects are."""
        with self.server.atomic():
            for node, pose in zip(self.nodes, physics.poses().tolist(), strict=True):
                if np.isfinite(pose).all():
                    node.position = tuple(pose[:3])
                    node.wxyz = (pose[6], *pose[3:6])
        if physics.has_diverged:
            self._playing.clear()
        self._tell_time()

    def _tell_time(self) -> None:
        physics = self._physics
        if physics is None:
            text = "Not started. The model is that of the stability verdict."
        elif physics.has_diverged:
            text = f"The simulation diverged at {physics.seconds:.2f} s. Reset puts the objects back."
        else:
            text = f"{physics.seconds:.2f} s simulated, {'running' if self._playing.is_set() else 'paused'}."
        self._clock.content = _html(f"<p class=note>{escape(text)}</p>")

    # --- what is drawn --------------------------------------------------------------------------------------------------------

    def _rebuild(self, *, keep_camera: bool = False) -> None:
        """Draws the scene of the row; a scene that cannot be shown leaves an empty picture."""
        self._playing.clear()
        self._physics, self._geometry = None, None
        if self._root is not None:
            self._root.remove()
        self.nodes, self._looks, self._parts, self._labels = [], [], [], []
        self._root = self.server.scene.add_frame("/scene", show_axes=False)
        row, count = self._row, len(self._scenes)
        self._head.content = _html(
            f"<h2>{breakable(str(row['scene_id']))}</h2><p class=note>Scene {self._number + 1:,} of {count:,}</p>"
        )
        self._facts.content = ""
        scene = scene_from_row(row)
        if self._is_before:
            before = self._earlier.scene(scene)
            if before is None:
                raise SceneError(f"{scene.scene_id}: the run does not store its poses before the correction", "not_stored")
            scene = before
        geometry = self._scenes.geometry(scene)
        self._facts.content = _html(SceneFacts.of(geometry, self._notes, row).html())
        self._draw(geometry)
        self._geometry = geometry
        self._tell_time()
        if not keep_camera:
            self._aim(geometry)

    def _draw(self, geometry: SceneGeometry) -> None:
        scene = self.server.scene
        scene.add_glb("/scene/table", table_glb(geometry), cast_shadow=False)
        for k, o in enumerate(geometry.scene.objects):
            # Names of nodes are numbers: the instances are any text, and a slash would be another level.
            name = f"/scene/object_{k}"
            turn = np.array(wxyz(yaw_quat(o.yaw)))
            self.nodes.append(scene.add_frame(name, show_axes=False, position=o.position, wxyz=turn))
            if not geometry.is_seen(k):
                continue  # the support shows it
            self._looks.append(scene.add_glb(f"{name}/look", object_glb(geometry, k)))
            text = o.instance if len(o.instance) <= _LABEL else o.instance[: _LABEL - 1] + "…"
            above = (0.0, 0.0, o.size[2] / 2 + 0.015)
            label = scene.add_label(f"{name}/label", text, position=above, anchor="bottom-center", font_screen_scale=0.8)
            self._labels.append(label)
        self._apply_visibility(geometry)

    def _draw_parts(self, geometry: SceneGeometry) -> None:
        """Draws the colliders: the convex parts of each object, each in a colour of its own."""
        for k, body in enumerate(geometry.bodies):
            surfaces = [Surface(part.triangles, _PARTS[n % len(_PARTS)]) for n, part in enumerate(body.parts)]
            self._parts.append(self.server.scene.add_glb(f"/scene/object_{k}/parts", surfaces_glb("parts", surfaces)))

    def _apply_visibility(self, geometry: SceneGeometry | None) -> None:
        """Shows and hides what is chosen."""
        if geometry is None:
            return
        if self._has_parts and not self._parts:
            self._draw_parts(geometry)
        drawn = (not self._has_parts, self._looks), (self._has_parts, self._parts), (self._has_labels, self._labels)
        for is_shown, nodes in drawn:
            for node in nodes:
                node.visible = is_shown
        for o, node in zip(geometry.scene.objects, self.nodes, strict=True):
            node.visible = o.stage not in self._hidden

    def _aim(self, geometry: SceneGeometry) -> None:
        """Lets all cameras look at the scene from the front."""
        view = view_point(geometry)
        first = self.server.initial_camera
        first.position, first.look_at, first.fov, first.near = view.eye, view.target, _FIELD_OF_VIEW, _NEAR
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at, client.camera.fov = view.eye, view.target, _FIELD_OF_VIEW

    # --- the panel ------------------------------------------------------------------------------------------------------------

    def _build_panel(self) -> None:
        gui = self.server.gui
        gui.set_panel_label(self._run.root.rstrip("/").rpartition("/")[2] or "scenes")
        # The share button would show the run to the internet.
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", brand_color=(53, 97, 142))
        gui.main_panel.dock_right()
        self.server.scene.world_axes.visible = False
        self.server.scene.set_background_image(np.linspace(*_SKY, 64).astype(np.uint8)[:, None].repeat(2, axis=1), "png")
        self._head = gui.add_html("")
        pager = gui.add_button_group("Page", ("Previous", "Next"))
        pager.on_click(lambda event: self.show(self._number + (1 if event.target.value == "Next" else -1)))
        with gui.add_form(None) as searching:
            name = gui.add_text("Go to", "", hint="A scene id, or a number from 1; Enter goes there.")
        searching.on_submit(lambda _: self.go_to(name.value))
        with gui.add_form(None) as filtering:
            condition = gui.add_text("Filter", "", hint="Such as: clean and num_stacked >= 2; Enter applies it.")
        filtering.on_submit(lambda _: self.filter(condition.value))
        self._message = gui.add_html("", visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Scene"):
            self._facts = gui.add_html("")
        with tabs.add_tab("Show"):
            self._build_show()
        with tabs.add_tab("Physics"):
            run = gui.add_button_group("Run", ("Play", "Pause", "Step", "Reset"))
            does = {"Play": self.play, "Pause": self.pause, "Step": self.step, "Reset": self.reset}
            run.on_click(lambda event: does[event.target.value]())
            self._clock = gui.add_html("")

    def _build_show(self) -> None:
        gui = self.server.gui
        options = (AFTER, BEFORE) if self._earlier.is_known else (AFTER,)
        self._poses = gui.add_dropdown("Poses", options, initial_value=AFTER, visible=self._earlier.is_known)
        self._poses.on_update(lambda event: self.set_poses(event.target.value))
        parts = gui.add_checkbox("Colliders", False, hint="The convex parts of the objects, which collide.")
        parts.on_update(lambda event: self.show_parts(event.target.value))
        labels = gui.add_checkbox("Labels", False)
        labels.on_update(lambda event: self.show_labels(event.target.value))
        boxes = {stage: gui.add_checkbox(words, True) for stage, words in _STAGES.items()}
        for box in boxes.values():
            box.on_update(lambda _: self.show_stages([stage for stage, own in boxes.items() if own.value]))

    def show_parts(self, is_shown: bool) -> None:
        """Shows the objects as their colliders, the convex parts; or as they look."""
        self._has_parts = is_shown
        self._refresh()

    def show_stages(self, stages: Collection[Stage]) -> None:
        """Shows the objects of these stages, and those without a stage."""
        self._hidden = frozenset(Stage) - frozenset(stages)
        self._refresh()

    def show_labels(self, is_shown: bool) -> None:
        """Shows or hides the names of the objects."""
        self._has_labels = is_shown
        self._refresh()

    def _refresh(self) -> None:
        with self._telling():
            self._apply_visibility(self._geometry)

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Runs one action at a time; an error becomes a message on the page, and the viewer goes on."""
        with self._lock:
            if self._acting:
                yield  # a part of another action, which tells the error
                return
            text, self._acting = "", True
            try:
                yield
            except StableDataError as error:
                text = str(error)
            except Exception as error:  # noqa: BLE001 - one scene or one click fails, the viewer goes on
                text = f"unexpected {type(error).__name__}: {error}; please report it"
            finally:
                self._acting = False
            if text:
                self._playing.clear()
            if text != self._text:
                self._text = text
                self._message.content = _html(f"<p class=remark>{escape(text)}</p>")
                self._message.visible = bool(text)


def serve(run: RunFolder, choice: SceneSelection, host: str, port: int, tell: Callable[[str], Any]) -> None:
    """Runs a viewer until it is interrupted (Ctrl-C).

    Args:
        run: The run.
        choice: The selection of its scenes.
        host: Address of this machine at which the server listens.
        port: Port of the server; 0: any free one.
        tell: Is given the address for the browser.

    Raises:
        ConfigError: As :class:`LiveViewer`.
    """
    with LiveViewer(run, choice, host, port) as viewer:
        shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host  # noqa: S104 - the user's choice
        tell(f"{viewer.num_scenes} scenes at http://{shown}:{viewer.port}; Ctrl-C ends the viewer")
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            tell("")


def _start(host: str, port: int) -> viser.ViserServer:
    """Starts the server, which would silently take the next free port if this one is in use.

    Raises:
        ConfigError: The port or the address cannot be used.
    """
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
            port = int(probe.getsockname()[1])
        except OSError as error:
            raise _unusable(host, port, error) from error
    with redirect_stdout(io.StringIO()):  # it prints a frame with its address
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if server.get_port() != port:  # another program was faster
        server.stop()
        raise _unusable(host, port, OSError(errno.EADDRINUSE, "Address already in use"))
    return server


def _unusable(host: str, port: int, error: OSError) -> ConfigError:
    if error.errno == errno.EADDRINUSE:
        message = (
            f"port {port} of {host} is in use, expected a free one; choose another with --port, or --port 0 for any free one"
        )
        return ConfigError(message, "port_in_use")
    reason = error.strerror or str(error)
    return ConfigError(f"{host}:{port} cannot be used ({reason}); choose another --host or --port", "port_unusable")


def _html(content: str) -> str:
    """A part of the panel with its style."""
    return f'<div class="scene-facts"><style>{style(".scene-facts")}</style>{content}</div>'
