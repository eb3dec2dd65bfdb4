"""Variants of a scene: all of it is kept but one axis, see :class:`~models.dual_system.variant_task.Axis`.

Each variant is a loop as :func:`~models.dual_system.algorithm1.dual_system` is one, so that the same batches, corrector and verdicts
serve both. What a variant must keep is compared with its source after each correction; an attempt that loses something is repeated.
"""

import re
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from typing import TypeAlias

import numpy as np

from models.dual_system.algorithm1 import LoopSettings, dual_system, with_wanted_relations
from models.dual_system.generation_state import supports_of
from models.dual_system.new_layout import draw_layout
from models.dual_system.requests import (
    Answer,
    CorrectionRequest,
    ExchangedAssets,
    ExchangeRequest,
    GenerationResult,
    Loop,
    Request,
    Turn,
)
from models.dual_system.variant_comparison import Comparison, ContainersOf, compare_variant, names_in, without_clutter
from models.dual_system.variant_task import Axis, VariantTask
from models.physics_corrector.certify.correction import Correction
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from stable_data.assets.catalog import Asset
from stable_data.assets.retrieval import AssetMatch, AssetQuery
from stable_data.assets.substitution import substitute_assets
from stable_data.errors import Notice, SceneError
from stable_data.instructions.deriving import derive_task, task_rng
from stable_data.instructions.naming import LOOK_WORDS
from stable_data.metrics.alignment import reference_of
from stable_data.random_seeds import named_seed
from stable_data.scene import TABLE, RelationKind, Scene, SceneObject, TaskInfo
from stable_data.scene_graph.relations import contacts_of, scene_graph
from stable_data.scene_graph.staging import stage_scene
from stable_data.scene_graph.support_tree import SupportTree

STEP = "vary"
"""The step that notices of this module name."""

NO_VARIANT = "no_variant"
"""Code of a variant that would equal its source, or for which nothing is found that differs."""

_DRAWS = 24  # of tasks, one after another, none of which is new: then there are no more
_ROUNDS = 4  # other assets that are tried for an object

Alternatives: TypeAlias = Callable[[str], Sequence[Asset]]
"""Returns the assets of a category that may be used, sorted by id."""


@dataclass(frozen=True, slots=True)
class VariantWorld:
    """What variants are made with.

    Attributes:
        interpret: Interprets instructions; None: new objects have no relations of the instruction.
        alternatives: The assets of a category.
        containers: Which objects of a scene are containers.
    """

    interpret: InstructionInterpreter | None
    alternatives: Alternatives
    containers: ContainersOf


def vary(task: VariantTask, seed: int, settings: LoopSettings, world: VariantWorld) -> Loop:
    """Makes a variant of a scene.

    Args:
        task: The variant.
        seed: Seed of all random choices, which follow from it and from the ids of the variant and of its source.
        settings: The schedule of new clutter, the number of attempts, and whether anything is corrected.
        world: What variants are made with.

    Yields:
        The next request.

    Returns:
        The variant, or why there is none.
    """
    variation = _Variation(task, seed, settings, world)
    if task.axis is Axis.TASK:
        return variation.with_another_task()
    if task.axis is Axis.CLUTTER:
        return (yield from variation.with_other_clutter())
    draw = variation.layout if task.axis is Axis.LAYOUT else variation.assets
    return (yield from variation.corrected(draw))


@dataclass(frozen=True, slots=True)
class _Start:
    """A variant before its correction.

    Attributes:
        scene: The scene.
        new: Objects that no correction has placed yet.
    """

    scene: Scene
    new: frozenset[str] = frozenset()


_Draw: TypeAlias = Callable[[int, frozenset[str]], Generator[Request, Answer, _Start | str]]
"""Draws the start of an attempt, given its number and the instances of which earlier ones lost something; or tells why there is none."""


@dataclass(frozen=True, slots=True)
class _Variation:
    """The loop of one variant. The attributes are the arguments of :func:`vary`."""

    task: VariantTask
    seed: int
    settings: LoopSettings
    world: VariantWorld

    def corrected(self, draw: _Draw) -> Generator[Request, Answer, GenerationResult]:
        """Draws starts and corrects each, until one keeps what it must; else the one that loses least."""
        best: tuple[tuple[bool, int], _Start, Correction] | None = None
        failure = self._failure(NO_VARIANT, "nothing differs")
        concerned: frozenset[str] = frozenset()
        for attempt in range(self.settings.tries):
            start = yield from draw(attempt, concerned)
            if isinstance(start, str):
                failure = self._failure(NO_VARIANT, start)
                continue
            if self.settings.corrects == "never":
                return GenerationResult(self.task, start.scene, start.scene, ())
            may_tilt = self.task.axis is Axis.ASSETS  # in another layout an object leans as it did
            done = yield CorrectionRequest(start.scene, frozenset(), start.new, is_last=True, may_tilt=may_tilt)
            assert isinstance(done, Correction)
            if done.certified is None:
                failure = self._failure(str(done.status), done.reason)
                continue
            found = self._compared(done.certified)
            unsteady = () if done.rest is None else done.rest.unsteady
            concerned |= found.concerned | set(unsteady)
            rank = not found.is_varied, len(found.lost) + len(unsteady)
            if best is None or rank < best[0]:
                best = rank, start, done
            if rank == (False, 0):
                break
        if best is None:
            return failure
        _, start, done = best
        assert done.certified is not None
        names = {o.instance for o in done.certified.objects}
        before = replace(start.scene, objects=tuple(o for o in start.scene.objects if o.instance in names))
        return GenerationResult(self.task, done.certified, before, (), done, done.dropped)

    def layout(self, attempt: int, _: frozenset[str]) -> Generator[Request, Answer, _Start | str]:
        """Draws new positions and yaws."""
        yield from ()
        base, containers = self.task.base, self.world.containers
        names = names_in(base, containers)

        def accepts(scene: Scene) -> bool:
            found = names_in(scene, containers)
            return all(found.get(span) == name for span, name in names.items())

        drawn = draw_layout(base, np.random.default_rng(named_seed(self.seed, self.task.scene_id, attempt)), accepts)
        if drawn is None:
            return "no other layout was found in which the relations and the names of the instruction hold"
        if drawn.task is not None:
            drawn = stage_scene(drawn)
        return _Start(with_wanted_relations(drawn, supports_of(base)))

    def assets(self, attempt: int, concerned: frozenset[str]) -> Generator[Request, Answer, _Start | str]:
        """Exchanges assets for others of their category, equal ones for equal ones; those of concerned objects are kept."""
        base = self.task.base
        stay = {o.asset_id for o in base.movable if o.instance in concerned}
        order = {o.asset_id: self._alternatives(o) for o in base.movable if o.asset_id is not None and o.asset_id not in stay}
        if not any(order.values()):
            return "no object has another asset of its category in the libraries"
        holders = {r.target for r in base.relations if r.kind is RelationKind.IN}
        wanted = {o.instance: (o, others) for o in base.movable if (others := order.get(o.asset_id or ""))}
        first = self.task.number - 1 + (0 if concerned else attempt)
        matches: dict[str, AssetMatch] = {}
        words: dict[str, str] = {}
        for turn in range(_ROUNDS):
            chosen = {}
            for name, (_, others) in wanted.items():
                if name not in matches and turn < len(others):
                    chosen[name] = self._nth(others, wanted[name][0].asset_id, first + turn)
            if not chosen:
                break
            queries = tuple(self._query(wanted[name][0], asset, name in holders) for name, asset in chosen.items())
            answer = yield ExchangeRequest(queries)
            assert isinstance(answer, ExchangedAssets)
            for (name, asset), match in zip(chosen.items(), answer.answers, strict=True):
                if isinstance(match, AssetMatch) and match.asset_id == asset.asset_id:
                    matches[name], words[name] = match, asset.words
        if not matches:
            return "no other asset of the category of an object can be used in its place"
        objects = substitute_assets(base.objects, matches)
        objects = tuple(replace(o, description=words.get(o.instance, o.description)) for o in objects)
        new = SupportTree.of(base.movable, base.scene_id).with_descendants(set(matches))
        return _Start(with_wanted_relations(replace(base, objects=objects), supports_of(base)), frozenset(new))

    def with_other_clutter(self) -> Generator[Request, Answer, GenerationResult]:
        """Removes the clutter and asks for other background objects."""
        task, best = self.task, None
        begun = without_clutter(task.base, self.world.containers)
        if task.source.task is None or not set(task.source.task.task_objects) & {o.instance for o in begun.scene.movable}:
            return self._failure(
                "task_objects_unknown", "the task names no object of the scene, so it is unknown what is clutter"
            )
        turns: tuple[Turn, ...] = ()
        for attempt in range(self.settings.tries):
            seed = named_seed(self.seed, self.task.scene_id, attempt)
            made = yield from dual_system(task, seed, self.settings, self.world.interpret, begun)
            turns += made.turns
            if made.scene is None:
                best = best or (((True, 0)), made)
                continue
            found = self._compared(made.scene)
            rest = None if made.correction is None else made.correction.rest
            rank = not found.is_varied, len(found.lost) + (0 if rest is None else len(rest.unsteady))
            if best is None or best[1].scene is None or rank < best[0]:
                best = rank, made
            if rank == (False, 0):
                break
        assert best is not None  # there is at least one attempt
        return replace(best[1], turns=turns)

    def with_another_task(self) -> GenerationResult:
        """Derives another task: of the different ones that are drawn, that with the number of the variant."""
        base = self.task.base
        graph = scene_graph(base, contacts_of(base), containers=self.world.containers(base))
        seen = [base.task] if base.task is not None else []
        draws, repeated = count(), 0
        while repeated < _DRAWS:
            try:
                task = derive_task(base, graph, task_rng(f"{self.task.source.scene_id}/{next(draws)}", self.seed))
            except SceneError as error:
                return self._failure(error.code, str(error))
            if any(_is_alike(task, other) for other in seen):
                repeated += 1
                continue
            seen.append(task)
            repeated = 0
            if len(seen) - (base.task is not None) == self.task.number:
                scene = stage_scene(replace(base, task=task))
                asked = replace(self.task, instruction=task.task, reference=None)
                with suppress(SceneError):
                    asked = replace(asked, reference=reference_of(scene))
                return GenerationResult(asked, scene, scene, ())
        num_other = len(seen) - (base.task is not None)
        return self._failure(NO_VARIANT, f"{num_other} other tasks were found that fit the scene, expected {self.task.number}")

    def _compared(self, scene: Scene) -> Comparison:
        return compare_variant(self.task.source, scene, self.task.axis, self.world.containers)

    def _alternatives(self, o: SceneObject) -> list[Asset]:
        """Other assets of the category of an object, which look as the instruction says."""
        said = _look(self.task.instruction) & _look(o.description)
        return [a for a in self.world.alternatives(o.category) if a.asset_id != o.asset_id and said <= _look(a.words)]

    def _nth(self, others: Sequence[Asset], asset_id: str | None, n: int) -> Asset:
        """The n-th of the assets in place of one, from 0, in a random order; after the last one they follow in another order."""
        again, k = divmod(n, len(others))
        # The order is that of all variants of a scene, each of which begins at another one.
        rng = np.random.default_rng(named_seed(self.seed, self.task.source.scene_id, asset_id, again))
        return others[int(rng.permutation(len(others))[k])]

    def _query(self, o: SceneObject, asset: Asset, holds: bool) -> AssetQuery:
        """Asks for one asset of all of its category, so that tilt and scale follow the rules of retrieval."""
        without = frozenset(a.asset_id for a in self.world.alternatives(o.category)) - {asset.asset_id}
        leans = o.support not in (None, TABLE)
        return AssetQuery(asset.words, o.size, o.category, self.task.scene_id, leans, holds, without)

    def _failure(self, code: str, message: str) -> GenerationResult:
        name = self.task.scene_id
        return GenerationResult(self.task, None, self.task.base, (), failure=Notice(name, STEP, code, f"{name}: {message}"))


def _look(text: str) -> frozenset[str]:
    """The words of a text for colour, material, pattern or shape."""
    return LOOK_WORDS & frozenset(re.findall(r"[a-z]+", text.lower()))


def _is_alike(one: TaskInfo, other: TaskInfo) -> bool:
    """Whether two tasks ask for the same; where the goal of one is unknown, tasks with the same objects count as that."""
    if " ".join(one.task.lower().split()) == " ".join(other.task.lower().split()):
        return True
    if one.conditions and other.conditions:
        return set(one.conditions) == set(other.conditions)
    if not (one.action_sequence and other.action_sequence):
        return set(one.task_objects) == set(other.task_objects)
    return (one.action_sequence, set(one.goal)) == (other.action_sequence, set(other.goal))
