"""Repairs one scene file in the calling process.

What has fallen is put upright, the Physics Corrector makes the scene clean, and the new poses are written into a copy of the file,
which is watched in its own physics. What is not at rest there is corrected again from where it came to.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from models.physics_corrector.certify import CertifyOptions
from models.physics_corrector.certify.correction import CorrectionOptions
from models.physics_corrector.certify.support_inference import is_hollow
from models.physics_corrector.corrector import PhysicsCorrector
from stable_data.assets.store import AssetStore
from stable_data.errors import Notice
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.importers.boundary import Boundary
from stable_data.importers.mjcf_files import Element, collect_files
from stable_data.importers.scenes.file_physics import BodyMotion
from stable_data.importers.scenes.formats import is_mjcf
from stable_data.importers.scenes.layouts import (
    ImportedScene,
    moved_bodies,
    scene_source,
    scenes_of_file,
    settled_object,
    turned_object,
)
from stable_data.importers.scenes.mjcf_scenes import INITIAL
from stable_data.importers.scenes.opening import read_scene_file
from stable_data.importers.scenes.scene_assets import SceneAssets
from stable_data.importers.scenes.scene_file import BodyPose, SceneFile
from stable_data.importers.scenes.standing import Upright, stands_firmly, uprighting
from stable_data.instructions.wording.vocabulary import classes_of
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import Audit
from stable_data.rotations import quat_of
from stable_data.scene import FloatArray, Scene

ALL_KEYS = "all"
"""Stands for all start states of a file, where a keyframe's name is expected."""

_ROUNDS = 4  # corrections of a file, each from where its physics brings what was not at rest
_FALLS = 30.0  # degrees: a body that turns as far has fallen


@dataclass(frozen=True, slots=True)
class RepairOptions:
    """What a user says about a scene file.

    Attributes:
        table: The body that carries all free bodies; empty: for each free body, the surface below it.
        key: Keyframe of the poses, or ``initial``; empty: ``home`` if there is one, else the initial poses; ``all``: the initial poses
            and each keyframe, one after the other.
        upright: What is put on its feet.
    """

    table: str = ""
    key: str = ""
    upright: Upright = "auto"


_DEFAULT = RepairOptions()


@dataclass(frozen=True, slots=True)
class BodyReport:
    """What the repair did to a free body.

    Attributes:
        name: The body.
        surface: The body on whose surface it stands.
        uprighted: Why it was turned; empty if it was not.
        move: Metres from its pose in the file.
        turn: Degrees likewise.
        faults_before: What was wrong with it; empty if nothing was.
        faults_after: What is still wrong with it.
        rest_before: Whether it stayed at rest in the physics of the file; None if it was not watched.
        rest_after: The same of the repaired file.
    """

    name: str
    surface: str
    uprighted: str
    move: float
    turn: float
    faults_before: tuple[str, ...]
    faults_after: tuple[str, ...]
    rest_before: bool | None
    rest_after: bool | None


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceRepair:
    """The correction of what stands on one surface.

    Attributes:
        before: The scene as in the file.
        after: The corrected scene; that of the file if none was found.
        audit_before: Its audit before.
        audit_after: Its audit after.
        uprighted: Instance -> why it was turned.
        reason: Why no clean scene was found; empty if it was.
    """

    before: Scene
    after: Scene
    audit_before: Audit
    audit_after: Audit
    uprighted: Mapping[str, str]
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Repair:
    """A repaired scene file.

    Attributes:
        path: The file.
        surfaces: The corrections of its surfaces.
        bodies: What was done to each free body.
        files: All files that it consists of, relative to its source folder.
        changed: Path -> new content, of the files that changed or are new; empty if nothing had to change.
        notices: Remarks on the file.
    """

    path: str
    surfaces: tuple[SurfaceRepair, ...]
    bodies: tuple[BodyReport, ...]
    files: tuple[str, ...]
    changed: Mapping[str, bytes]
    notices: tuple[Notice, ...] = ()

    @property
    def was_clean(self) -> bool | None:
        """Whether the file was clean; None if a verdict is unknown."""
        return _all(s.audit_before.card().clean for s in self.surfaces)

    @property
    def is_clean(self) -> bool | None:
        """Whether the repaired file is clean; likewise."""
        return _all(s.audit_after.card().clean for s in self.surfaces)

    @property
    def was_at_rest(self) -> bool | None:
        """Whether all bodies stayed at rest in the physics of the file; None if it was not watched."""
        return _all(b.rest_before for b in self.bodies)

    @property
    def is_at_rest(self) -> bool | None:
        """Whether all bodies stay at rest in the physics of the repaired file; likewise."""
        return _all(b.rest_after for b in self.bodies)


def _all(verdicts: Iterable[bool | None]) -> bool | None:
    found = list(verdicts)
    return False if False in found else None if None in found else True


def repair_states(boundary: Boundary, path: str, options: RepairOptions = _DEFAULT) -> tuple[Repair, ...]:
    """Repairs the poses of a scene file that are asked for: one, or with the key ``all`` each start state that it states.

    Args:
        boundary: The source folder.
        path: The file, relative to it.
        options: What the user says about it.

    Returns:
        The repairs. With ``all`` they are named ``PATH#KEY``, and each changes the files that those before it have left.

    Raises:
        StableDataError: The file cannot be read, or its poses cannot be changed.
    """
    if options.key != ALL_KEYS or not is_mjcf(path):
        return (repair_file(boundary, path, options),)
    files = collect_files(boundary, path)
    changed: dict[str, bytes] = {}
    found: list[Repair] = []
    for key in (INITIAL, *_stated_keys(files.elements)):
        with files.placed(changed) as place:
            root = Boundary(place.parents[path.count("/")], boundary.limits)
            repair = repair_file(root, path, replace(options, key=key), is_everywhere=False)
        changed |= repair.changed
        found.append(replace(repair, path=f"{path}#{key.removeprefix('#')}", changed=dict(changed)))
    return tuple(found)


def _stated_keys(elements: Sequence[Element]) -> list[str]:
    """The keyframes that state joint positions: their names, or ``#`` with their numbers."""
    keys = [e.tag.attributes for e in elements if e.tag.name == "key"]
    return [key.get("name") or f"#{k}" for k, key in enumerate(keys) if key.get("qpos", "").strip()]


def repair_file(boundary: Boundary, path: str, options: RepairOptions = _DEFAULT, *, is_everywhere: bool = True) -> Repair:
    """Repairs a scene file; the file itself is not changed.

    Args:
        boundary: The source folder.
        path: The file, relative to it.
        options: What the user says about it.
        is_everywhere: Whether all places of a MuJoCo file that state the same pose of a body get its new one.

    Raises:
        StableDataError: The file cannot be read, or its poses cannot be changed.
    """
    source = read_scene_file(boundary, path, options.key, is_everywhere=is_everywhere)
    before = source.watch()
    at_rest = {name: motion.is_at_rest for name, motion in before.items()}
    correction = FileCorrection(source.file, options, at_rest)
    surfaces = correction.surfaces()
    best = _Attempt([replace(s, after=s.before, audit_after=s.audit_before, uprighted={}) for s in surfaces], {}, {}, before)
    for k in range(_ROUNDS):
        poses = moved_bodies(s.after for s in surfaces)
        changed, motions = source.moved(poses) if poses else ({}, before)
        attempt = _Attempt(surfaces, poses, changed, motions)
        if attempt.score > best.score or (k == 0 and attempt.score == best.score):  # as good, and nothing lies any more
            best = attempt
        if attempt.is_done:
            break
        surfaces = [correction.settled(surface, attempt.motions) for surface in surfaces]
    reports = _body_reports(source.file, best.surfaces, best.poses, before, best.motions)
    return Repair(path, tuple(best.surfaces), tuple(reports), source.paths, best.changed, source.file.notices)


@dataclass(frozen=True, slots=True, eq=False)
class _Attempt:
    """A version of the repaired file."""

    surfaces: Sequence[SurfaceRepair]
    poses: Mapping[str, BodyPose]
    changed: Mapping[str, bytes]
    motions: Mapping[str, BodyMotion]

    @property
    def score(self) -> tuple[int, int]:
        """Clean surfaces, then bodies at rest."""
        clean = sum(s.audit_after.card().clean is True for s in self.surfaces)
        return clean, sum(motion.is_at_rest for motion in self.motions.values())

    @property
    def is_done(self) -> bool:
        """Whether nothing is left to repair."""
        return self.score == (len(self.surfaces), len(self.motions))


class FileCorrection:
    """Corrects the scenes of a file.

    Args:
        file: The file.
        options: What the user says about it.
        at_rest: Name of a body -> whether it stays at rest in the physics of the file, where that is known.
    """

    def __init__(self, file: SceneFile, options: RepairOptions, at_rest: Mapping[str, bool]) -> None:
        self._file, self._options, self._at_rest = file, options, at_rest
        self._imported = scenes_of_file(file, options.table)
        self._assets = SceneAssets()
        self._assets.add(self._imported)
        self._store = AssetStore(self._assets)
        self._corrector = PhysicsCorrector(options=CertifyOptions(when_full="infeasible"), judges_raw=False)

    def surfaces(self) -> list[SurfaceRepair]:
        """The corrected scenes."""
        return [self._corrected(one) for one in self._imported]

    def _corrected(self, imported: ImportedScene) -> SurfaceRepair:
        before, shapes, _ = self._store.resolved(imported.scene)
        audit = audit_scene(before, shapes)
        upright, reasons = put_upright(replace(imported, scene=before), self._file, self._options.upright, self._at_rest)
        return self._repaired(SurfaceRepair(before, before, audit, audit, {}), upright, reasons)

    def settled(self, surface: SurfaceRepair, motions: Mapping[str, BodyMotion]) -> SurfaceRepair:
        """Corrects a scene again, from where the physics of the file brings what is not at rest; all bodies, if it is not clean.

        An object that falls over stays as it was; one that cannot stand, such as a ball, rolls on.
        """
        is_clean = surface.audit_after.card().clean is True
        objects = []
        for o in surface.after.objects:
            motion = None if o.instance in surface.after.fixed else motions[str((o.source or {})["body"])]
            if motion is not None and not (is_clean and motion.is_at_rest):
                mesh = self._assets.assets[o.asset_id or ""].mesh
                if motion.turn < _FALLS or (np.isfinite(motion.turn) and not stands_firmly(mesh.vertices)):
                    o = settled_object(o, mesh, surface.after, motion.end)
            objects.append(o)
        return self._repaired(surface, replace(surface.after, objects=tuple(objects)), surface.uprighted)

    def _repaired(self, surface: SurfaceRepair, start: Scene, uprighted: Mapping[str, str]) -> SurfaceRepair:
        done = self._corrector.correct([start], self._store, CorrectionOptions(asks_engine=True))[0]
        if done.certified is None or done.audit is None:
            return replace(surface, reason=done.reason)
        return replace(surface, after=done.certified, audit_after=done.audit, uprighted=uprighted, reason=done.engine_fault)


def put_upright(
    imported: ImportedScene, file: SceneFile, mode: Upright, at_rest: Mapping[str, bool]
) -> tuple[Scene, dict[str, str]]:
    """Turns the objects of a scene that have fallen over.

    Args:
        imported: The scene.
        file: Its file.
        mode: What is put on its feet.
        at_rest: Name of a body -> whether it stays at rest in the physics of the file, where that is known.

    Returns:
        The scene; and instance -> why it was turned.
    """
    scene, reasons = imported.scene, dict[str, str]()
    bodies = {body.name: body for body in file.bodies}
    frame = Rotation.from_euler("z", scene_source(scene)["yaw"])
    objects = []
    for o in scene.objects:
        assert o.source is not None
        assert o.asset_id is not None
        body, asset = bodies[o.source["body"]], imported.assets[o.asset_id]
        if o.instance not in scene.fixed:
            shape = np.concatenate([part.vertices for part in body.parts])
            middle = (shape.min(axis=0) + shape.max(axis=0)) / 2
            center = middle if body.center_of_mass is None else np.array(body.center_of_mass)
            found = uprighting(
                shape,
                center,
                body.quat_xyzw,
                body.known_quats,
                is_at_rest=at_rest.get(body.name),
                mode=mode,
                opens_up=partial(_opens_up, asset.mesh),
                stands_on_end="upright" in classes_of(o.category),
            )
            if found is not None:
                pivot = frame.inv().apply(body.center - np.array(scene_source(scene)["origin"]))
                o = turned_object(o, asset.mesh, frame.inv() * found.rotation * frame, pivot)
                reasons[o.instance] = found.reason
        objects.append(o)
    return replace(scene, objects=tuple(objects)), reasons


def _opens_up(mesh: Mesh, down: FloatArray) -> bool:
    """Whether a mesh is hollow and its opening points up when a direction of its frame, (3,), points down."""
    turn, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])
    return is_hollow(Shape.from_mesh(mesh, (1.0, 1.0, 1.0), quat_of(turn)))


def _body_reports(
    file: SceneFile,
    surfaces: Sequence[SurfaceRepair],
    poses: Mapping[str, BodyPose],
    before: Mapping[str, BodyMotion],
    after: Mapping[str, BodyMotion],
) -> list[BodyReport]:
    bodies = {body.name: body for body in file.bodies}
    reports = []
    for surface in surfaces:
        was, now = _faults(surface.before, surface.audit_before), _faults(surface.after, surface.audit_after)
        for o in surface.before.objects:
            if o.instance in surface.before.fixed:
                continue
            name = (o.source or {})["body"]
            body = bodies[name]
            position, quat = poses.get(name, (body.position, body.quat_xyzw))
            turn = (Rotation.from_quat(quat) * Rotation.from_quat(body.quat_xyzw).inv()).magnitude()
            reports.append(
                BodyReport(
                    name,
                    str(scene_source(surface.before)["surface"]),
                    surface.uprighted.get(o.instance, ""),
                    float(np.linalg.norm(np.subtract(position, body.position))),
                    float(np.degrees(turn)),
                    was[o.instance],
                    now[o.instance],
                    before[name].is_at_rest if name in before else None,
                    after[name].is_at_rest if name in after else None,
                )
            )
    return reports


def _faults(scene: Scene, audit: Audit) -> dict[str, tuple[str, ...]]:
    """Instance -> what is wrong with it."""
    name_of = {o.instance: str((o.source or {}).get("body", o.instance)) for o in scene.objects}
    found: dict[str, list[str]] = {o.instance: [] for o in scene.objects}
    for pair in audit.pairs:
        for one, other in ((pair.first, pair.second), (pair.second, pair.first)):
            if pair.penetration is None:
                found[one].append(f"perhaps in {name_of[other]}")
            elif pair.penetration > audit.tolerance:
                found[one].append(f"{1e3 * pair.penetration:.1f} mm in {name_of[other]}")
    for o in audit.objects:
        found[o.instance] += ["floats"] * bool(o.floats)
        if o.table_penetration > audit.tolerance:
            found[o.instance].append(f"{1e3 * o.table_penetration:.1f} mm in the table")
        found[o.instance] += ["off the table"] * bool(o.is_outside)
    return {instance: tuple(faults) for instance, faults in found.items()}
