"""The verdicts of physics engines on a finished scene, as columns of ``scenes`` and notices."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pipelines.correct.settings import CorrectorJobSettings
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError, Notice
from stable_data.geometry.shape import Shape
from stable_data.judges.registry import DISAGREE, ask_judges, describe, disagree, judge_columns
from stable_data.judges.robust_rest import stable_share
from stable_data.metrics.card import MetricCard
from stable_data.metrics.judge_columns import SHARE
from stable_data.scene import Scene
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import SettleResult
from stable_data.storage import schemas


@dataclass(frozen=True, slots=True, eq=False)
class JudgedScene:
    """The verdicts on a scene.

    Attributes:
        verdicts: The verdicts by judge.
        columns: The columns of the judges other than MuJoCo, and of robust rest.
        notices: Warnings about judges that disagree or could not judge.
    """

    verdicts: Mapping[str, SettleResult]
    columns: schemas.Row
    notices: tuple[Notice, ...] = ()

    @property
    def rest(self) -> SettleResult | None:
        """The verdict of MuJoCo, or None if it was not asked or could not be."""
        return self.verdicts.get("mujoco")

    def filled(self, card: MetricCard) -> MetricCard:
        """The card with the verdict of MuJoCo."""
        rest = self.rest
        if rest is None:
            return card
        return replace(
            card,
            engine_penetration_mm=rest.engine_penetration_mm,
            settle_move_max_mm=rest.settle_move_max_mm,
            settle_turn_max_deg=rest.settle_turn_max_deg,
            drift_mm=rest.drift_mm,
            jitter_mm=rest.jitter_mm,
            stable=rest.stable,
        )


def judge_scene(
    scene: Scene,
    shapes: Sequence[Shape],
    store: AssetStore,
    settings: CorrectorJobSettings,
    rest: SettleResult | None = None,
) -> JudgedScene:
    """Asks the judges of a job about a scene.

    Args:
        scene: The scene, resolved.
        shapes: The geometry of its objects, in its order.
        store: The store of their meshes.
        settings: The job's settings.
        rest: The verdict of MuJoCo on this scene, if the correction has it.
    """
    name, judges = scene.scene_id, settings.judge_names
    known = {} if rest is None else {"mujoco": rest}
    blank = {**judge_columns({}), SHARE: None}
    if not judges and not settings.robust_rest:
        return JudgedScene({}, blank)
    needs_bodies = settings.robust_rest > 0 or not set(judges) <= set(known)
    try:
        bodies = bodies_of(scene, shapes, store) if needs_bodies else []
    except MeshError as error:
        message = f"{name}: the physics engine was not used: {error}"
        return JudgedScene(known if "mujoco" in judges else {}, blank, (Notice(name, "settle", "not_settled", message),))
    verdicts = ask_judges(judges, bodies, scene.table, settings.arbiter, known)
    notices = tuple(
        Notice(name, "settle", "judge_unknown", f"{name}: {judge} could not judge the scene: {verdict.reason}")
        for judge, verdict in verdicts.items()
        if verdict.stable is None and judge != "mujoco"
    )
    if disagree(verdicts):
        notices += (Notice(name, "settle", DISAGREE, f"{name}: {describe(verdicts)}"),)
    share = stable_share(name, bodies, scene.table, settings.robust_rest) if settings.robust_rest else None
    return JudgedScene(verdicts, {**judge_columns(verdicts), SHARE: share}, notices)
