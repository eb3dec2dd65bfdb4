"""The gain of each part of the corrector's training: short equal trainings that leave one part out, judged by raw samples.

``python -m benchmarks.corrector_ablation RUN --out OUT [--arm NAME ...] [--steps N] [--seeds K] [--json FILE]``, where RUN is the folder
of a preprocess run. Every arm trains on the same scenes with the same seed for the same number of steps, and differs from
``full`` in one point:

- ``full``: the network of the preset ``embedded_set`` with heights that are learned and all physical losses on sampled poses;
- ``no support``, ``no table``, ``no objects``: without L_sup, L_obj-table, L_obj-obj, as in the paper's ablation;
- ``no physics``: without all three, only L_flow;
- ``box features``: without point features; a shape is then known only by the extents of its box, which every network reads;
- ``no texts``: without text features of categories and tables;
- ``no self-conditioning``: without the earlier clean estimate as an input;
- ``geometric heights``: heights follow from the supports;
- ``unet``: the paper's U-Net over the objects (preset ``embedded``) instead of the set transformer.

Judged are raw samples of the flow on held-out scenes, without certification, by the training's own validation card
(docs/training_the_corrector.md): the mean over all its rows. With several seeds, a figure is the mean over the trainings, with half of
the width of its 95 % interval (Student's t). A finished training is not repeated, and an interrupted one resumes; OUT stores them.
Trainings this short show the direction of an effect, not the result of a long training. Run with ``OMP_NUM_THREADS=1 IGL_NUM_THREADS=1``.
"""

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Any, TypeAlias

import torch
import typer

from models.physics_corrector.training.losses import LossSettings
from models.physics_corrector.training.perturbation import PerturbationSettings
from models.physics_corrector.training.settings import CorrectorTrainingSettings, PhysicsSchedule, training_preset
from models.physics_corrector.training.validation import Card
from pipelines.reports.text_table import align_columns
from pipelines.train.corrector import CorrectorTrainingJob
from pipelines.train.layouts import LayoutMonitoring
from stable_data.errors import StableDataError
from stable_data.scores.intervals import mean_text

FULL = "full"

Change: TypeAlias = Callable[[CorrectorTrainingSettings], CorrectorTrainingSettings]


def _losses(**changes: float) -> Change:
    return lambda settings: replace(settings, losses=replace(settings.losses, **changes))


def _without_physics(settings: CorrectorTrainingSettings) -> CorrectorTrainingSettings:
    bare = replace(settings.losses, sdf_weight=0.0, support_weight=0.0, bounds_weight=0.0)
    return replace(settings, losses=bare, physics=replace(settings.physics, share=0.0, unroll_share=0.0))


def full_settings(steps: int, seed: int) -> CorrectorTrainingSettings:
    """Returns the settings of the full training."""
    settings = training_preset("embedded_set")
    flow = replace(settings.corrector.flow, heights="learned", steps=4)
    return replace(
        settings,
        steps=steps,
        seed=seed,
        batch_size=32,
        chunk=16,
        warm_up=200,
        cool_down=0.4,
        ema=0.998,
        perturbation=PerturbationSettings(jitter=0.4, swap=0.05, edge=0.05),
        physics=PhysicsSchedule(share=0.5, limit=1.0, unroll_share=0.8, unroll_scenes=0.5, unroll_weight=2.0),
        losses=LossSettings(sdf_weight=5.0, support_weight=2.5, bounds_weight=0.5, clearance=1e-3),
        corrector=replace(settings.corrector, flow=flow),
    )


def _with_network(**changes: Any) -> Change:
    return lambda settings: replace(
        settings, corrector=replace(settings.corrector, network=replace(settings.corrector.network, **changes))
    )


def _with_flow(**changes: Any) -> Change:
    return lambda settings: replace(
        settings, corrector=replace(settings.corrector, flow=replace(settings.corrector.flow, **changes))
    )


def _with_unet(settings: CorrectorTrainingSettings) -> CorrectorTrainingSettings:
    network = training_preset("embedded").corrector.network
    return replace(settings, corrector=replace(settings.corrector, network=network))


ARMS: Mapping[str, Change] = {
    FULL: lambda settings: settings,
    "no support": _losses(support_weight=0.0),
    "no table": _losses(table_factor=0.0),
    "no objects": _losses(object_factor=0.0),
    "no physics": _without_physics,
    "box features": lambda settings: replace(settings, features="box"),
    "no texts": _with_network(num_texts=0),
    "no self-conditioning": _with_flow(self_condition=0.0),
    "geometric heights": _with_flow(heights="geometry"),
    "unet": _with_unet,
}
"""Arm -> its change of the full training."""

FIGURES = (
    "grid_oc",
    "oc",
    "max_penetration_mm",
    "table_penetration_mm",
    "float_rate",
    "max_gap_mm",
    "out_of_bounds_rate",
    "move_mean_mm",
    "target_distance_mm",
)
"""The figures of the validation card in the table."""


@dataclass(frozen=True, slots=True)
class Arm:
    """One training with its result.

    Attributes:
        name: Its name.
        seed: Seed of the training.
        steps: Number of training steps.
        batch_size: Scenes of a step.
        num_parameters: Number of parameters of its network.
        card: Its validation card.
    """

    name: str
    seed: int
    steps: int
    batch_size: int
    num_parameters: int
    card: Card

    def figure(self, name: str, side: str = "raw") -> float | None:
        """Returns the mean of a figure over the rows of the card; None if one is unknown."""
        values = [row[side].get(name) for row in self.card.values()]
        known = [value for value in values if value is not None]
        return mean(known) if known and len(known) == len(values) else None


def arm(run: str, out: Path, name: str, full: CorrectorTrainingSettings, watch: LayoutMonitoring) -> Arm:
    """Trains an arm, or the missing steps of it.

    Args:
        run: Folder of the preprocess run.
        out: Folder of all arms, with one cache of the data computed from the run.
        name: One of ``ARMS``.
        full: Settings of the full training, with its length.
        watch: Settings of the validation.
    """
    folder = out / f"seed_{full.seed}" / name.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    (out / "cache").mkdir(exist_ok=True)
    if not (folder / "cache").exists():
        (folder / "cache").symlink_to((out / "cache").resolve())
    settings = ARMS[name](full)
    job = CorrectorTrainingJob(run, folder, settings, watch)
    card = folder / "card.json"
    if not card.is_file() or json.loads(card.read_text("utf-8"))["steps"] != full.steps:
        print(job.run())
    if not card.is_file():
        raise SystemExit(f"{folder}: the training stopped before its end; run the command again to resume it")
    found: dict[str, Any] = json.loads(card.read_text("utf-8"))
    network, _ = settings.resolved(1).corrector.build()
    return Arm(
        name, full.seed, found["steps"], settings.batch_size, sum(p.numel() for p in network.parameters()), found["rows"]
    )


def table(arms: Sequence[Arm]) -> str:
    """Returns a table of the figures of all arms, means over their seeds, after those of the coarse layouts."""
    rows: list[tuple[str, ...]] = [("arm", "parameters", "seeds", *FIGURES)]
    if arms:
        rows.append(("coarse layout", "", "", *(_written(arms[:1], name, "coarse") for name in FIGURES)))
    for arm_name in dict.fromkeys(a.name for a in arms):
        own = [a for a in arms if a.name == arm_name]
        rows.append((arm_name, f"{own[0].num_parameters:,}", str(len(own)), *(_written(own, name) for name in FIGURES)))
    return align_columns(rows, 1)


def _written(arms: Sequence[Arm], name: str, side: str = "raw") -> str:
    is_length, values = name.endswith("_mm"), [a.figure(name, side) for a in arms]
    text = mean_text([None if value is None else value * (1 if is_length else 100) for value in values], 2)
    return "-" if text is None else text if is_length else f"{text} %"


def main(
    run: Annotated[str, typer.Argument(help="Folder of a preprocess run.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the trainings; without it they are deleted.")] = None,
    name: Annotated[list[str] | None, typer.Option("--arm", help=f"Of {', '.join(ARMS)}; all by default.")] = None,
    steps: Annotated[int, typer.Option(help="Length of each training.")] = 1500,
    scenes: Annotated[int, typer.Option(help="Held-out scenes of the card.")] = 96,
    exact: Annotated[int, typer.Option(help="Number of these that the exact audit judges.")] = 24,
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each arm, with the seeds 0, 1 and so on.")] = 1,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Trains the missing arms and prints the figures of all chosen ones."""
    chosen = list(dict.fromkeys(name or ARMS))
    if unknown := [wrong for wrong in chosen if wrong not in ARMS]:
        raise typer.BadParameter(f"{', '.join(unknown)}, expected of {', '.join(ARMS)}")
    torch.set_num_threads(1)
    watch = LayoutMonitoring(card_every=steps + 1, final_scenes=scenes, exact_scenes=exact)
    with tempfile.TemporaryDirectory() as aside:
        try:
            every = [full_settings(steps, seed) for seed in range(seeds)]
            arms = [arm(run, out or Path(aside), one, full, watch) for full in every for one in chosen]
        except StableDataError as error:
            raise SystemExit(str(error)) from error
    print(table(arms))
    if file is not None:
        document = [asdict(a) for a in arms]
        file.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
