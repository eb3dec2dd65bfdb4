"""One shard of the edit job: scenes are read, the reasoner is asked for all edits at once, and each reply is applied.

The rows of a shard depend on the shard alone.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar

from models.physics_corrector.certify.correction import Correction, Fixed
from models.semantic_reasoner.editing import EditPrompt, EditResult, apply_edit, edit_prompt_of
from models.semantic_reasoner.engines.protocol import OFF
from models.semantic_reasoner.factory import load_reasoner
from models.semantic_reasoner.reasoner import Proposal, SemanticReasoner
from models.semantic_reasoner.staged_layout import table_with_zone
from models.semantic_reasoner.text.reply_json import parse_reply
from pipelines.correct.judging import judge_scene
from pipelines.correct.reaching import reach_scene
from pipelines.correct.scene_shard import SceneWork, SceneWorkerState, corrector_of, notices_of
from pipelines.correct.shard import correction_row
from pipelines.edit.assets import AssetFinder
from pipelines.edit.correcting import EditCorrector, missed_relations
from pipelines.edit.settings import EditSettings
from pipelines.edit.tilts import fit_tilts
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import ProcessFailure
from pipelines.execution.shard_step import Rows, engine_stopped, rows_or_failure
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.edits import EditRequest
from pipelines.sources.scenes import SourceScene, scene_source
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.card import MetricCard, add_counts
from stable_data.metrics.related_scene import relate_scene
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene, SceneObject
from stable_data.scene_graph.staging import stage_scene
from stable_data.storage import schemas
from stable_data.storage.table_rows import card_row, notice_row, object_row, scene_row


@dataclass(frozen=True, slots=True, eq=False)
class EditReply:
    """A reply, applied to its scene.

    Attributes:
        edited: The edited scene, or the reason why there is none.
        notices: Warnings about the question or the reply.
    """

    edited: EditResult | Notice
    notices: tuple[Notice, ...] = ()


@dataclass(frozen=True, slots=True)
class EditWork(SceneWork[EditSettings, EditRequest, EditReply]):
    """The work of one shard: an item is an edit, and its answer is the applied reply.

    Attributes:
        assets: Libraries that are searched after that of the scenes, see :class:`~pipelines.sources.assets.AssetLibraries`.
    """

    TABLES: ClassVar = ("warnings", "failures", "corrections", "edits", "grasps", "scenes")
    UNIT: ClassVar = "edit"

    assets: tuple[str, ...] = ()

    def item_id(self, item: EditRequest) -> str:
        """The edit's id."""
        return item.edit_id

    def opened(self) -> "_Opened":
        """The source, the corrector and the asset finder, cached in this process."""
        return _opened(self)

    @property
    def seconds_to_answer(self) -> None:
        """No time limit: the engine of the reasoner has its own."""

    def prepare_to_ask(self, items: Sequence[EditRequest]) -> None:
        """Opens the reasoner if an edit has no reply."""
        opened = self.opened()
        if any(edit.reply is None for edit in items):
            _ = opened.reasoner

    def look(self, item: EditRequest, progress: ItemProgress) -> None:
        """Reads the scene of an edit."""
        edit_prompt_of(self.take(item.scene_id, progress).scene)

    def answers(self, items: Sequence[EditRequest]) -> list[EditReply]:
        """Applies the replies to the scenes; all edits without a reply are sent to the reasoner in one batch.

        Raises:
            ConfigError: The engine no longer answers (``engine_off``).
        """
        shown = [edit_prompt_of(self.take(edit.scene_id, ItemProgress("read")).scene) for edit in items]
        waiting = [k for k, edit in enumerate(items) if edit.reply is None]
        proposals: dict[int, Proposal] = {}
        if waiting:
            asks = [shown[k].question(items[k].instruction) for k in waiting]
            seeds = [seed_of(items[k], self.settings.seed) for k in waiting]
            proposals = dict(zip(waiting, self.opened().reasoner.propose(asks, seeds), strict=True))
            for k, proposal in proposals.items():
                if proposal.code in OFF:
                    raise engine_stopped(f"{items[k].edit_id}: {proposal.failure}")
        return [_replied(edit, own, proposals.get(k)) for k, (edit, own) in enumerate(zip(items, shown, strict=True))]

    def unanswered(self, loss: ProcessFailure, items: Sequence[EditRequest]) -> ConfigError:
        """The error if the process of the reasoner was lost."""
        told = loss.told(self.settings.seconds_per_item, len(items))
        found = f"the reasoner, for edits such as {items[0].edit_id}, {told}"
        return ConfigError(f"{found}; free memory, or set scenes_per_shard lower", "engine_failed")

    def finished(self, item: EditRequest, answer: EditReply) -> Rows:
        """The rows of one edit from its reply."""
        edited = answer.edited
        if isinstance(edited, Notice):
            return {"failures": [notice_row(edited)], "warnings": _notice_rows(item, answer.notices)}
        progress = ItemProgress("assets")
        rows = rows_or_failure(item.edit_id, progress, lambda: self._rows(item, edited, answer.notices, progress))
        return {"warnings": _notice_rows(item, answer.notices)} | rows

    def _rows(self, edit: EditRequest, replied: EditResult, said: Sequence[Notice], progress: ItemProgress) -> Rows:
        taken, opened = self.take(edit.scene_id, progress), self.opened()
        notices = [*taken.notices, *said]
        progress.step = "assets"
        found = opened.finder.assign(replied, edit.edit_id, self.settings.seed)
        notices += found.notices
        progress.step = "mesh"
        scene, _, odd = opened.source.store.resolved(replace(found.scene, scene_id=edit.edit_id))
        notices += [n for n in odd if n.message not in {known.message for known in taken.notices}]
        scene = fit_tilts(scene, taken.scene, replied, opened.source.store)
        shapes, _ = opened.source.store.shapes(scene)
        progress.step = "stage"
        scene, gone = _staged(scene, self.settings.important_threshold)
        notices += gone
        progress.step = "audit"
        posed = PosedScene(scene, shapes)
        audit = audit_posed_scene(posed)
        notices += audit.notices
        card: MetricCard | None = audit.card()
        rows: Rows = {}
        if self.settings.correct and replied.kind != "none":
            progress.step = "certify"
            done, noted = self._corrected(scene, audit, replied, replied.untouched & found.kept)
            notices += noted
            rows["corrections"] = [correction_row(done)]
            if done.certified is None or done.audit is None:
                message = f"{edit.edit_id}: {done.reason}"
                failure = Notice(edit.edit_id, "certify", str(done.status), message)
                return rows | {"failures": [notice_row(failure)], "warnings": _notice_rows(edit, notices)}
            if missed := missed_relations(replied.wanted, done):
                message = f"{edit.edit_id}: {', '.join(map(str, missed))} cannot hold in a clean layout"
                failure = Notice(edit.edit_id, "certify", "relation_missed", message)
                return rows | {"failures": [notice_row(failure)], "warnings": _notice_rows(edit, notices)}
            posed = PosedScene(done.certified, opened.source.store.shapes(done.certified)[0])
            audit, card = done.audit, done.card_after
        progress.step = "relations"
        containers = opened.shelf.containers(posed.scene)
        scene = relate_scene(posed, audit, containers).scene
        assert card is not None  # a certified scene has a card
        card = add_sampled_collisions(add_counts(card, scene), scene, posed.shapes, audit)
        if replied.kind == "none":
            notices.append(Notice(edit.edit_id, "reply", "nothing_changed", f"{edit.edit_id}: the reply changes nothing"))
        progress.step = "settle"
        judged = judge_scene(scene, posed.shapes, opened.source.store, self.settings)
        notices += judged.notices
        card = judged.filled(card)
        progress.step = "reach"
        reach = reach_scene(scene, opened.source.store, self.settings, containers)
        columns = {**judged.columns, **reach.columns}
        rows["scenes"] = [{**scene_row(scene), **card_row(card), **columns, **audit.rows(), **taken.origin}]
        rows["grasps"] = reach.grasps
        rows["edits"] = [_edit_row(edit, replied.kind, taken, scene)]
        return rows | {"warnings": _notice_rows(edit, notices)}

    def _corrected(self, scene: Scene, audit: Audit, edited: EditResult, untouched: Fixed) -> tuple[Correction, list[Notice]]:
        """Corrects a scene, and names the objects that moved although the edit does not mention them."""
        done = self.opened().edit_corrector.correct(scene, audit, edited, untouched)
        notices = notices_of(done, scene.scene_id)
        if done.certified is not None:
            was = {o.instance: (o.position, o.yaw) for o in scene.objects if o.instance in untouched}
            moved = [o.instance for o in done.certified.objects if was.get(o.instance, ()) not in ((), (o.position, o.yaw))]
            if moved:
                message = f"{scene.scene_id}: {', '.join(moved)} moved too, because there was no clean layout otherwise"
                notices.append(Notice(scene.scene_id, "certify", "others_moved", message))
        return done, notices


def seed_of(edit: EditRequest, seed: int) -> int:
    """The seed of an edit, from the edit and the job's seed; it does not depend on the shard."""
    return int(content_id(seed, edit.edit_id, edit.scene_id, edit.instruction), 16)


def _replied(edit: EditRequest, shown: EditPrompt, proposal: Proposal | None) -> EditReply:
    """Applies the reply of an edit, or the proposal of the reasoner if it has none, to its scene."""
    notices = []
    if proposal is not None:
        told = [(n.step, n.code, n.message) for n in proposal.notices]
        told += [("reply", f.code, f.message) for f in proposal.faults if f.code != "nothing_changed"]  # reported later
        notices = [Notice(edit.edit_id, step, code, f"{edit.edit_id}: {message}") for step, code, message in told]
    try:
        reply = parse_reply(edit.reply or "") if proposal is None else proposal.reply
        if reply is not None:
            return EditReply(apply_edit(shown, reply), tuple(notices))
        assert proposal is not None
        code, reason = proposal.code, _with_instances(proposal.failure, shown.names)
    except SceneError as error:
        code, reason = error.code, str(error)
    return EditReply(Notice(edit.edit_id, "reply", code or "no_reply", f"{edit.edit_id}: {reason}"), tuple(notices))


def _with_instances(text: str, names: Mapping[str, str]) -> str:
    """A text with the scene's instances in place of their names in the prompt."""
    instances = {name: instance for instance, name in names.items()}
    return re.sub(r"\w+", lambda m: instances.get(m[0], m[0]), text)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Opened(SceneWorkerState):
    """The objects that a process caches for its work.

    Attributes:
        settings: The job's settings.
        shelf: The asset libraries, that of the scenes first.
        finder: Finds assets for new objects.
    """

    settings: EditSettings
    shelf: AssetLibraries
    finder: AssetFinder

    @property
    def edit_corrector(self) -> EditCorrector:
        """The corrector of edited scenes."""
        return EditCorrector(self.settings, self.corrector, self.source.store)

    @cached_property
    def reasoner(self) -> SemanticReasoner:
        """The reasoner, opened at the first edit without a reply."""
        reasoner, _ = load_reasoner(self.settings.engine, self.settings.reasoner)
        return reasoner


@lru_cache(maxsize=1)
def _opened(work: EditWork) -> _Opened:
    settings, shelf = work.settings, AssetLibraries(work.assets, scenes=work.scenes)
    source = scene_source(work.scenes, shelf)
    corrector = corrector_of(settings, source.store, work.correctors, flows=settings.correct)
    return _Opened(source, corrector, settings=settings, shelf=shelf, finder=AssetFinder(source, shelf))


def _staged(scene: Scene, threshold: float) -> tuple[Scene, list[Notice]]:
    """The scene with updated stages, and with a task from which removed objects are deleted."""
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
        message = f"{scene.scene_id}: the task {task.task!r} mentions {', '.join(gone)}, which the edit removed"
        notices = [Notice(scene.scene_id, "stage", "task_object_removed", message)]
    return stage_scene(scene, threshold), notices


def _edit_row(edit: EditRequest, kind: str, taken: SourceScene, after: Scene) -> schemas.Row:
    """The row of ``edits``: all changes of the scene, including those of the correction."""
    before = {o.instance: o for o in taken.scene.objects}
    names = {o.instance for o in after.objects}
    changed = [o for o in after.objects if o.instance not in before or _is_other(o, before[o.instance])]
    # The table as the reasoner sees it, so that a model is trained on the question that it is asked.
    head = scene_row(replace(taken.scene, table=table_with_zone(taken.scene.table, taken.scene.surroundings)))
    return {
        "edit_id": edit.edit_id,
        **{name: head[name] for name in ("scene_id", "table_type", "table_size", "restricted_zone")},
        "split": taken.origin["split"],
        "kind": kind,
        "instruction": edit.instruction,
        "objects_in": [object_row(o, with_source=False) for o in taken.scene.movable],
        "objects_out": [object_row(o, with_source=False) for o in changed],
        "removed": [name for name in before if name not in names],
    }


def _is_other(o: SceneObject, was: SceneObject) -> bool:
    """Whether the pose or the asset of an object differs; stage and support are ignored."""
    return replace(o, stage=was.stage, support=was.support) != was


def _notice_rows(edit: EditRequest, notices: Sequence[Notice]) -> list[schemas.Row]:
    return [notice_row(replace(n, item_id=edit.edit_id)) for n in notices]
