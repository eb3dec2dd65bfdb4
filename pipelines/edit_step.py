"""One shard of the edit job: scenes taken, the reasoner asked for all of them at once, each reply carried out; their rows.

A shard's rows depend on nothing but the shard.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Literal, TypeAlias, TypeVar

from models.physics_corrector.certify import CertifyOptions, Status
from models.physics_corrector.corrector import Correction, PhysicsCorrector
from models.physics_corrector.learned import load_flow
from models.semantic_reasoner.assembly import load_reasoner
from models.semantic_reasoner.editing import EditedScene, Editing, apply_edit, editing
from models.semantic_reasoner.layout_text import parse_reply
from models.semantic_reasoner.reasoner import Proposal, SemanticReasoner
from pipelines.correct_step import correction_row
from pipelines.edit_assets import AssetFinder, resting_on
from pipelines.edit_file import WantedEdit
from pipelines.edit_settings import EditSettings
from pipelines.job import Rows, rows_alone, rows_or_failure
from pipelines.progress import Progress
from pipelines.runner import Loss, alone, limited
from pipelines.scene_source import SceneSource, Taken, scene_source
from pipelines.scene_step import num_carried, related
from stable_data import tables
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.metrics.audit import Audit, PosedScene, audit_posed
from stable_data.metrics.card import MetricCard
from stable_data.metrics.collision import ROUNDING
from stable_data.scene import Scene, SceneObject
from stable_data.shape import Shape
from stable_data.shards import RunFolder, content_id
from stable_data.staging import stage_scene

I = TypeVar("I")  # noqa: E741 - an item

WhenFull: TypeAlias = Literal["drop", "infeasible"]

EDIT_TABLES = ("warnings", "failures", "corrections", "edits", "scenes")
"""Tables of a shard, in the order in which they are put in place."""


@dataclass(frozen=True, slots=True)
class EditShard:
    """Edits that are done together.

    Attributes:
        shard_id: Content of its inputs, the engine, the weights and the settings that shape it.
        edits: The edits.
    """

    shard_id: str
    edits: tuple[WantedEdit, ...]

    def __len__(self) -> int:
        return len(self.edits)

    def __str__(self) -> str:
        return f"shard {self.shard_id} ({len(self.edits)} edits)"


@dataclass(frozen=True, slots=True, eq=False)
class Replied:
    """What a reply makes of a scene.

    Attributes:
        edited: The scene, or why there is none.
        notices: What about the question or the reply deserves a look.
    """

    edited: EditedScene | Notice
    notices: tuple[Notice, ...] = ()


@dataclass(frozen=True, slots=True)
class EditWork:
    """The work of one shard; sent to the workers.

    Attributes:
        scenes: Where the scenes are: an absolute path or a URI that every worker can read.
        out: The run's folder, which every worker can write, likewise.
        settings: The job's settings.
        fingerprint: Content of the inputs: what a process keeps of one is not used for another in the same place.
    """

    scenes: str
    out: str
    settings: EditSettings
    fingerprint: str = ""

    def __call__(self, shard: EditShard, *, isolated: bool = False) -> tuple[int, int]:
        """Does the shard and puts its tables in place; gives its edits and how many of them failed."""
        rows: dict[str, list[tables.Row]] = defaultdict(list)
        usable = []
        for edit in shard.edits:
            failed = self._limited(self.taken, edit, edit.edit_id, isolated)
            _add(rows, failed)
            if not failed:
                usable.append(edit)
        for item in zip(usable, self._replies(usable, isolated), strict=True):
            _add(rows, self._limited(self.edited, item, item[0].edit_id, isolated))
        if not isolated:  # else nothing was opened here
            _opened(self).taken.clear()
        out = RunFolder(self.out)
        for table in EDIT_TABLES:
            out.write_shard(table, shard.shard_id, rows[table])
        return len(shard), len(rows["failures"])

    def taken(self, edit: WantedEdit) -> Rows:
        """Takes an edit's scene from its source; gives the row of its failure, or nothing."""
        progress = Progress("read")

        def take() -> Rows:
            editing(self._take(edit.scene_id, progress).scene)
            return {}

        return rows_or_failure(edit.edit_id, progress, take)

    def replies(self, edits: Sequence[WantedEdit]) -> list[Replied]:
        """What the replies make of the scenes of some edits; the reasoner is asked for all of them at once."""
        shown = [editing(self._take(edit.scene_id, Progress("read")).scene) for edit in edits]
        waiting = [k for k, edit in enumerate(edits) if edit.reply is None]
        proposals: dict[int, Proposal] = {}
        if waiting:
            asks = [shown[k].ask(edits[k].instruction) for k in waiting]
            seeds = [seed_of(edits[k], self.settings.seed) for k in waiting]
            proposals = dict(zip(waiting, _opened(self).reasoner.propose(asks, seeds), strict=True))
        return [_replied(edit, own, proposals.get(k)) for k, (edit, own) in enumerate(zip(edits, shown, strict=True))]

    def edited(self, item: tuple[WantedEdit, Replied]) -> Rows:
        """Rows of one edit, from its reply."""
        edit, replied = item
        edited = replied.edited
        if isinstance(edited, Notice):
            return {"failures": [tables.notice_row(edited)], "warnings": _notice_rows(edit, replied.notices)}
        progress = Progress("assets")
        rows = rows_or_failure(edit.edit_id, progress, lambda: self._rows(edit, edited, replied.notices, progress))
        return {"warnings": _notice_rows(edit, replied.notices)} | rows

    def _rows(self, edit: WantedEdit, replied: EditedScene, said: Sequence[Notice], progress: Progress) -> Rows:
        taken, opened = self._take(edit.scene_id, progress), _opened(self)
        notices = [*taken.notices, *said]
        progress.step = "assets"
        found = opened.finder.with_assets(replied, edit.edit_id, self.settings.seed)
        notices += found.notices
        progress.step = "mesh"
        scene, shapes, odd = opened.source.store.resolved(replace(found.scene, scene_id=edit.edit_id))
        notices += [n for n in odd if n.message not in {known.message for known in taken.notices}]
        progress.step = "stage"
        scene, gone = _staged(scene, self.settings.important_threshold)
        notices += gone
        progress.step = "audit"
        posed = PosedScene(scene, shapes)
        audit = audit_posed(posed)
        card: MetricCard | None = audit.card()
        rows: Rows = {}
        if self.settings.correct and replied.kind != "none":
            progress.step = "certify"
            done, noted = self._corrected(scene, shapes, audit, replied.untouched & found.kept)
            notices += noted
            rows["corrections"] = [correction_row(done)]
            if done.certified is None or done.audit is None:
                message = f"{edit.edit_id}: {done.reason}"
                failure = Notice(edit.edit_id, "certify", str(done.status), message)
                return rows | {"failures": [tables.notice_row(failure)], "warnings": _notice_rows(edit, notices)}
            shape_of = {o.instance: shape for o, shape in zip(scene.objects, shapes, strict=True)}
            posed = PosedScene(done.certified, [shape_of[o.instance] for o in done.certified.objects])
            audit, card = done.audit, done.card_after
        progress.step = "relations"
        scene, _ = related(posed, audit, opened.source.containers(posed.scene))
        stacked, contained = num_carried(scene)
        assert card is not None  # a certified scene has one
        card = replace(card, num_stacked=stacked, num_contained=contained)
        if replied.kind == "none":
            notices.append(Notice(edit.edit_id, "reply", "nothing_changed", f"{edit.edit_id}: the reply changes nothing"))
        rows["scenes"] = [{**tables.scene_row(scene), **tables.card_row(card), **audit.rows(), **taken.origin}]
        rows["edits"] = [_edit_row(edit, replied.kind, taken, scene)]
        return rows | {"warnings": _notice_rows(edit, notices)}

    def _corrected(
        self, scene: Scene, shapes: Sequence[Shape], audit: Audit, untouched: frozenset[str]
    ) -> tuple[Correction, list[Notice]]:
        """The scene corrected, with what the edit does not name fixed as the settings say."""
        always = self.settings.fixed_in(scene)
        wished = [always | untouched, always | (untouched - _at_fault(scene, audit)), always]
        allowed = {"fixed": wished[:1], "free": wished[2:], "fixed_first": wished}[self.settings.others]
        for fixed in dict.fromkeys(allowed):
            tried = self._certified(scene, shapes, audit, fixed)
            if fixed == allowed[0] or not _is_poor(tried):
                done = tried
            if not _is_poor(tried):
                break
        notices = [
            Notice(scene.scene_id, "certify", "dropped", f"{scene.scene_id}: {d.instance} is left out: {d.reason}")
            for d in done.dropped
        ]
        if done.certified is not None:
            was = {o.instance: (o.position, o.yaw) for o in scene.objects if o.instance in untouched}
            moved = [o.instance for o in done.certified.objects if was.get(o.instance, ()) not in ((), (o.position, o.yaw))]
            if moved:
                message = f"{scene.scene_id}: {', '.join(moved)} moved too, for there was no clean layout otherwise"
                notices.append(Notice(scene.scene_id, "certify", "others_moved", message))
        if done.status is Status.UNKNOWN:
            notices.append(Notice(scene.scene_id, "certify", "unknown", f"{scene.scene_id}: {done.reason}"))
        return done, notices

    def _certified(self, scene: Scene, shapes: Sequence[Shape], audit: Audit, fixed: frozenset[str]) -> Correction:
        corrector = _opened(self).corrector
        (raw,) = corrector.raw([scene], [shapes], [fixed])
        return corrector.certified(scene, shapes, audit, raw, fixed)

    def _replies(self, edits: Sequence[WantedEdit], isolated: bool) -> list[Replied]:
        if not isolated:
            return self.replies(edits)
        seconds = self.settings.seconds_per_item * max(1, len(edits))
        found = alone(self.replies, edits, seconds=seconds, prepare=self._prepare_to_ask)
        if isinstance(found, Loss):
            raise ConfigError(
                f"the reasoner {str(found).replace('_', ' ')} over {len(edits)} edits such as {edits[0].edit_id}; free memory, or "
                "set scenes_per_shard lower",
                "engine_failed",
            )
        return found

    def _limited(self, make: Callable[[I], Rows], item: I, edit_id: str, isolated: bool) -> Rows:
        seconds = self.settings.seconds_per_item
        if isolated:
            return rows_alone(make, item, edit_id, seconds=seconds, prepare=self._prepare)
        self._prepare()
        with limited(seconds):
            return make(item)

    def _prepare(self) -> None:
        """Opens what edits need, outside of the time of the first one."""
        _opened(self)

    def _prepare_to_ask(self) -> None:
        _ = _opened(self).reasoner

    def _take(self, scene_id: str, progress: Progress) -> Taken:
        opened = _opened(self)
        if scene_id not in opened.taken:
            opened.taken[scene_id] = opened.source.take(scene_id, self.settings.scene_settings(), progress)
        return opened.taken[scene_id]


def seed_of(edit: WantedEdit, seed: int) -> int:
    """The seed of an edit's draws: of the edit and the job's seed, whichever shard it is in."""
    return int(content_id(seed, edit.edit_id, edit.scene_id, edit.instruction), 16)


def _replied(edit: WantedEdit, shown: Editing, proposal: Proposal | None) -> Replied:
    """What the reply of an edit, or what was proposed where it has none, makes of its scene."""
    notices = []
    if proposal is not None:
        told = [(n.step, n.code, n.message) for n in proposal.notices]
        told += [("reply", f.code, f.message) for f in proposal.faults if f.code != "nothing_changed"]  # which is seen later
        notices = [Notice(edit.edit_id, step, code, f"{edit.edit_id}: {message}") for step, code, message in told]
    try:
        reply = parse_reply(edit.reply or "") if proposal is None else proposal.reply
        if reply is not None:
            return Replied(apply_edit(shown, reply), tuple(notices))
        assert proposal is not None
        code, reason = proposal.code, proposal.failure
    except SceneError as error:
        code, reason = error.code, str(error)
    return Replied(Notice(edit.edit_id, "reply", code or "no_reply", f"{edit.edit_id}: {reason}"), tuple(notices))


@dataclass(frozen=True, eq=False)
class _Opened:
    """What a process keeps of its work.

    Attributes:
        settings: Of the job.
        source: Where the scenes are.
        finder: Finds assets for what is new.
        corrector: Corrects the edited scenes.
        taken: The scenes of the shard, each of which is asked for three times.
    """

    settings: EditSettings
    source: SceneSource
    finder: AssetFinder
    corrector: PhysicsCorrector
    taken: dict[str, Taken] = field(default_factory=dict)

    @cached_property
    def reasoner(self) -> SemanticReasoner:
        """The reasoner, opened when the first edit without a reply comes."""
        reasoner, _ = load_reasoner(self.settings.engine, self.settings.reasoner)
        return reasoner


@lru_cache(maxsize=1)
def _opened(work: EditWork) -> _Opened:
    settings, source = work.settings, scene_source(work.scenes)
    when_full: WhenFull = "drop" if settings.when_full == "drop" else "infeasible"
    options = CertifyOptions(when_full=when_full, restore=settings.restore)
    flow = load_flow(settings.weights, settings.steps) if settings.correct else None
    corrector = PhysicsCorrector(flow, options, settings.judge_raw)
    return _Opened(settings, source, AssetFinder(source), corrector)


def _is_poor(done: Correction) -> bool:
    """Whether something was not found a place."""
    return done.certified is None or bool(done.dropped)


def _at_fault(scene: Scene, audit: Audit) -> frozenset[str]:
    """What keeps a scene from being clean, with all that rests on it."""
    deep = audit.tolerance + ROUNDING
    found = {
        o.instance for o in audit.objects if o.floats is not False or o.is_outside is not False or o.table_penetration > deep
    }
    for pair in audit.pairs:
        if pair.penetration is None or pair.penetration > audit.tolerance:
            found |= {pair.first, pair.second}
    return frozenset(resting_on(scene, found))


def _staged(scene: Scene, threshold: float) -> tuple[Scene, list[Notice]]:
    """The scene with stages as they are now, and its task without objects that are gone."""
    task = scene.task
    if task is None:
        return scene, []
    names = {o.instance for o in scene.objects}
    gone = [name for name in task.task_objects if name not in names]
    notices = []
    if gone:
        relations = tuple(r for r in task.relations if names >= {r.subject} and r.target not in gone)
        there = tuple(name for name in task.task_objects if name in names)
        scene = replace(scene, task=replace(task, task_objects=there, relations=relations))
        message = f"{scene.scene_id}: the task {task.task!r} speaks of {', '.join(gone)}, which the edit took away"
        notices = [Notice(scene.scene_id, "stage", "task_object_removed", message)]
    return stage_scene(scene, threshold), notices


def _edit_row(edit: WantedEdit, kind: str, taken: Taken, after: Scene) -> tables.Row:
    """What was done in all, correction and others that moved included."""
    before = {o.instance: o for o in taken.scene.objects}
    names = {o.instance for o in after.objects}
    changed = [o for o in after.objects if o.instance not in before or _is_other(o, before[o.instance])]
    head = tables.scene_row(taken.scene)
    return {
        "edit_id": edit.edit_id,
        **{name: head[name] for name in ("scene_id", "table_type", "table_size", "restricted_zone")},
        "split": taken.origin["split"],
        "kind": kind,
        "instruction": edit.instruction,
        "objects_in": [tables.object_row(o, with_source=False) for o in taken.scene.objects],
        "objects_out": [tables.object_row(o, with_source=False) for o in changed],
        "removed": [name for name in before if name not in names],
    }


def _is_other(o: SceneObject, was: SceneObject) -> bool:
    """Whether it is elsewhere or another thing, whatever its stage and support."""
    return replace(o, stage=was.stage, support=was.support) != was


def _notice_rows(edit: WantedEdit, notices: Sequence[Notice]) -> list[tables.Row]:
    return [tables.notice_row(replace(n, item_id=edit.edit_id)) for n in notices]


def _add(rows: dict[str, list[tables.Row]], new: Rows) -> None:
    for table, found in new.items():
        rows[table] += found
