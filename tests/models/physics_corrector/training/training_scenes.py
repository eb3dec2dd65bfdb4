"""A small training set whose scenes are known: balls, cubes and a bowl in a row, some on others, in three stages."""

from dataclasses import replace

import torch

from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.flow.velocity_network import VelocityNetworkSettings
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.dataset import TrainingSet
from models.physics_corrector.training.settings import CorrectorTrainingSettings
from stable_data.scene import Scene
from tests.models.physics_corrector.geometry.shapes import RADIUS, SIDE, batch_of, scene, thing

TINY = CorrectorTrainingSettings(
    steps=8,
    batch_size=8,
    chunk=3,
    learning_rate=3e-3,
    features="box",
    corrector=CorrectorSettings(
        VelocityNetworkSettings(
            "set_transformer",
            channels=32,
            levels=2,
            heads=2,
            context_channels=32,
            time_channels=32,
            pair_channels=16,
            num_features=0,
            num_codes=8,
            code_channels=8,
        )
    ),
).resolved(6)


def row(number: int) -> Scene:
    """A cube with a ball on it, two equal balls, a plate; where they stand depends on the number."""
    x = 0.15 + 0.01 * number
    return scene(
        thing("cube", (x, 0.2, SIDE / 2, 0.1 * number), support="table"),
        thing("ball_1", (x, 0.2, SIDE + RADIUS, 0.5), support="cube"),
        thing("ball_2", (x + 0.25, 0.3, RADIUS, 0.0), support="table"),
        thing("ball_3", (x + 0.25, 0.6, RADIUS, 0.0), support="table"),
        thing("plate", (x + 0.5, 0.3, 0.005, -0.1 * number), support="table"),
    )


STAGES = torch.tensor([0, 1, 1, 2, 2])


def rows(count: int, num_slots: int = 6) -> LayoutBatch:
    return batch_of([row(n) for n in range(count)], num_slots=num_slots)[0]


def training_set(count: int = 6, held_out: int = 2) -> TrainingSet:
    scenes = [row(n) for n in range(count + held_out)]
    batch, geometry = batch_of(scenes, num_slots=6)
    stage = torch.full(batch.mask.shape, -1)
    stage[:, : len(STAGES)] = STAGES
    words = torch.full((len(scenes), 7), -1)
    words[:, [*range(len(STAGES)), -1]] = torch.tensor([0, 1, 1, 1, 2, 3])
    split = torch.tensor([0] * count + [1] * held_out)
    names, texts = tuple(f"row-{n}" for n in range(len(scenes))), ("cube", "ball", "plate", "desk")
    return TrainingSet(batch, geometry, stage, words, split, names, {}, "made up", texts)


def with_fixed(batch: LayoutBatch, place: int) -> LayoutBatch:
    is_fixed = batch.is_fixed.clone()
    is_fixed[:, place] = True
    return replace(batch, is_fixed=is_fixed)
