"""Scenes to rate, and replies of a scripted endpoint."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from models.scene_rating.pictures import picture_number
from models.scene_rating.prompt import NUMBERS
from models.scene_rating.rating_case import RatingCase
from stable_data.rating.criteria import KEYS
from stable_data.scene import Scene, Tabletop, TaskInfo
from stable_data.simulation.offscreen import Picture

SCORES: dict[str, float] = dict(zip(KEYS, (9, 9.5, 9.5, 9, 9), strict=True))


def picture(shade: int) -> Picture:
    return np.full((96, 96, 3), shade, np.uint8)


def pictured_case(scene_id: str, task: str | None = None, **more: Any) -> RatingCase:
    """A scene with two plain pictures; its task names it."""
    words = f"Rate {scene_id}." if task is None else task
    scene = Scene(scene_id, Tabletop("office_table", (1.2, 0.6)), (), TaskInfo("An office.", words))
    return RatingCase(scene, **{"clean": True, "front": picture(200), "perspective": picture(90), **more})


def reply_for(scene_id: str, scores: Mapping[str, Any] = SCORES, **more: Any) -> str:
    """The reply of a model that sees the pictures of a scene."""
    found: dict[str, Any] = {NUMBERS[name]: picture_number(scene_id, name) for name in NUMBERS}
    found |= {key: {"rationale": f"It is {score}.", "score": score} for key, score in scores.items()}
    return json.dumps({**found, **more})


def scene_named(words: str) -> str:
    """The id of the scene in the text of a question."""
    return words.partition("Rate ")[2].partition(".")[0]
