"""Policies of somebody else, as a command line names them."""

import numpy as np


class StayingPolicy:
    """Does not move, and keeps the hand open."""

    def reset(self) -> None:
        self.asked = 0

    def act(self, observation: dict) -> np.ndarray:  # type: ignore[type-arg]
        self.asked += 1
        return np.array([0, 0, 0, 0, 0, 0, 0.05])


class BrokenPolicy(StayingPolicy):
    """Fails at its second question."""

    def act(self, observation: dict) -> np.ndarray:  # type: ignore[type-arg]
        if self.asked:
            raise RuntimeError("no idea")
        return super().act(observation)


class ShortPolicy(StayingPolicy):
    """Gives too few numbers."""

    def act(self, observation: dict) -> np.ndarray:  # type: ignore[type-arg]
        return np.zeros(3)


class WeighedPolicy(StayingPolicy):
    """Says what weights it has."""

    def __init__(self, fingerprint: str) -> None:
        self.fingerprint = fingerprint


WEIGHTS = ["first"]


def weighed() -> WeighedPolicy:
    return WeighedPolicy(WEIGHTS[0])


def lost() -> StayingPolicy:
    raise FileNotFoundError("no weights here")
