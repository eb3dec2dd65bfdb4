"""The rows of a generated scene: its card, its turns, why it is rejected."""

from collections.abc import Mapping
from dataclasses import asdict, replace

from models.dual_system.requests import GenerationResult, Turn
from models.dual_system.variant_comparison import Comparison
from models.dual_system.variant_task import VariantTask
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import assistant_message
from pipelines.correct.judging import JudgedScene
from stable_data.assets.store import AssetStore
from stable_data.metrics.alignment import Alignment, AlignmentReference, align, requires_the_same
from stable_data.metrics.audit import PosedScene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.movement import add_movement
from stable_data.metrics.reach_columns import GRASPABLE, REACHABLE
from stable_data.metrics.related_scene import RelatedScene
from stable_data.metrics.relations_kept import relations_kept
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene
from stable_data.simulation.settling import SettleResult
from stable_data.storage import schemas


def with_movement(
    card: MetricCard, made: GenerationResult, scene: Scene, posed: PosedScene, audit: Audit, store: AssetStore
) -> MetricCard:
    """Adds to a card how far the corrections moved the proposed objects, and how many relations they kept."""
    start, there = made.start, {o.instance for o in made.start.objects}
    if there != {o.instance for o in scene.objects}:
        return card
    order = {o.instance: k for k, o in enumerate(scene.objects)}
    start = replace(start, objects=tuple(sorted(start.objects, key=lambda o: order[o.instance])))
    start, shapes, _ = store.resolved(start)  # with the proposed tilts
    # The objects of a stage were judged at their proposed poses before they were corrected.
    corrections = [correction for turn in made.turns for correction in turn.corrections]
    known = [(c.start, c.audit_before) for c in corrections if c.audit_before is not None]
    kept = relations_kept(start, scene, shapes, posed.shapes, audits=(None, audit), known=known)
    return add_movement(card, start, scene, kept)


def with_alignment(
    card: MetricCard,
    seen: RelatedScene,
    containers: Mapping[str, bool | None],
    task: LayoutTask,
    interpret: InstructionInterpreter | None,
) -> tuple[MetricCard, tuple[str, ...]]:
    """Adds AwT, AwS and the distractor rate to a card, by the task's labels and as it was read; also returns what is not as it says."""

    def compared(reference: AlignmentReference) -> Alignment:
        return align(seen.scene, reference, contacts=seen.contacts, footprints=seen.footprints, containers=containers)

    if task.reference is not None:
        found = compared(task.reference)
        is_annotated = task.reference.graph is not None
        card = replace(
            card,
            awt=found.awt,
            aws=found.aws,
            aws_graph=found.aws_graph,
            awt_annotated=found.awt if is_annotated else None,
            distractor_rate=found.distractor_rate,
        )
    reference = None if interpret is None or not task.instruction else interpret(task.instruction).stated
    if reference is None:
        return card, ()
    read = compared(reference)
    is_same = None if task.reference is None else requires_the_same(task.reference, reference)
    card = replace(card, awt_understood=read.awt, aws_understood=read.aws, read_as_labelled=is_same)
    lost = tuple(f"the instruction mentions {one}, which is missing" for one in dict.fromkeys(map(str, read.missing)))
    if read.broken:
        names = {r.instance: str(r) for r in reference.required}
        broken = (f"{names[r.subject]} {r.kind} {names.get(r.target, r.target)}" for r in read.broken)
        lost += (f"the instruction states relations that do not hold: {', '.join(broken)}",)
    elif read.broken is None and reference.entailed:
        lost += ("too many objects are alike to tell whether the relations that the instruction states hold",)
    return card, lost


def variant_columns(task: VariantTask, compared: Comparison) -> schemas.Row:
    """The columns of a variant: its source, whose split and near-duplicate group it has, and how much of it differs."""
    found: schemas.Row = {"variant_of": task.source.scene_id, "varied": str(task.axis), "num_varied": compared.num_varied}
    return found | {"split": task.split, "duplicate_group": task.duplicate_group}


def why_rejected(rule: str, values: dict[str, object], judged: JudgedScene, of_task: str | None) -> str:
    """Says why a scene is not accepted.

    Args:
        rule: The rule of acceptance.
        values: The values of its columns.
        judged: The verdicts of the judges, with their reasons.
        of_task: Why the robot cannot do the task; None if it can, or if that is not known.
    """
    said = ", ".join(f"{column} is {'unknown' if value is None else value}" for column, value in values.items())
    reason = "".join(f"; {verdict.reason}" for verdict in judged.verdicts.values() if verdict.reason)
    if of_task is not None and not {REACHABLE, GRASPABLE}.isdisjoint(values):
        reason += f"; {of_task}"
    return f"not accepted by {rule!r}: {said}{reason}"


def turn_row(name: str, number: int, turn: Turn) -> schemas.Row:
    """The row of ``turns`` for a turn of a scene, by the scene's id and the number of the turn."""
    p, done = turn.proposal, turn.corrections[-1] if turn.corrections else None
    return {
        "scene_id": name,
        "turn": number,
        "stage": str(turn.wanted),
        "tries": p.tries,
        "refused": [[f.code for f in r.faults] for r in p.refused],
        "reply": None if p.reply is None else assistant_message(p.reply.objects),
        "prompt_tokens": p.prompt_tokens,
        "reply_tokens": p.reply_tokens,
        "cost": p.cost,
        "unmatched": [] if turn.assigned is None else sorted(turn.assigned.unmatched),
        "coarse": None if done is None else _poses(done.start),
        "corrected": None if done is None or done.certified is None else _poses(done.certified),
        "solved_by": None if done is None or done.solved_by is None else str(done.solved_by),
        "card_before": None if done is None or done.card_before is None else asdict(done.card_before),
        "card_after": None if done is None or done.card_after is None else asdict(done.card_after),
        "dropped": [] if done is None else [asdict(d) for d in done.dropped],
        "code": turn.code,
        "reason": turn.rejected,
    }


def _poses(scene: Scene) -> list[schemas.Row]:
    return [{"instance": o.instance, "position": o.position, "yaw": o.yaw} for o in scene.movable]


def settled_row(name: str, rest: SettleResult) -> schemas.Row:
    """The row of ``settled`` for a scene, by its id: where its objects have come to rest."""
    poses = zip(rest.names, rest.positions.tolist(), rest.quats_xyzw.tolist(), strict=True)
    return {"scene_id": name, "poses": [{"instance": n, "position": p, "quat_xyzw": q} for n, p, q in poses]}
