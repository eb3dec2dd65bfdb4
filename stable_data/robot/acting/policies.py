"""Policies: what acts in an environment, ours or anybody's, and how one is named on a command line."""

import inspect
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from stable_data.errors import ConfigError
from stable_data.robot.env import Observation


@runtime_checkable
class ActingPolicy(Protocol):
    """Acts by what it observes."""

    def reset(self) -> None:
        """Begins a new episode."""
        ...

    def act(self, observation: Observation) -> npt.ArrayLike:
        """Returns the next action, (A,), or the next K actions, (K, A), which are carried out before the next question.

        Args:
            observation: As :class:`stable_data.robot.env.RobotEnv` gives it.
        """
        ...


def actions_of(
    policy: ActingPolicy, observation: Observation, num_actions: int, name: str
) -> Iterator[npt.NDArray[np.float32]]:
    """Asks a policy once; yields the actions, each (A,) float32.

    Args:
        policy: The policy.
        observation: What it observes.
        num_actions: Numbers of an action, A.
        name: Of the policy, for errors.

    Raises:
        ConfigError: The answer has another shape, or is not finite (``policy_invalid``).
    """
    answer = np.asarray(policy.act(observation), np.float32)
    actions = answer[None] if answer.ndim == 1 else answer
    if actions.ndim != 2 or not len(actions) or actions.shape[1] != num_actions or not np.isfinite(actions).all():
        kind = "numbers that are not finite" if answer.size and not np.isfinite(answer).all() else f"shape {answer.shape}"
        raise ConfigError(
            f"policy {name}: act() gave {kind}, expected finite numbers of shape ({num_actions},) or (K, {num_actions})",
            "policy_invalid",
        )
    yield from actions


def import_policy(name: str) -> ActingPolicy:
    """Returns the policy that ``module:function`` makes; the function takes no arguments, and may be a class.

    The module is looked for in the current folder too.

    Raises:
        ConfigError: There is no such module or name, it raises an error, or what it gives has no ``reset`` and ``act``
            (``policy_invalid``).
    """
    module, _, attribute = name.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        maker: Any = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"policy {name}: {error}, expected module:function of a policy", "policy_invalid") from error
    try:
        policy = maker() if callable(maker) else maker
    except Exception as error:  # a program of the user's
        raise ConfigError(
            f"policy {name}: {attribute}() raised {type(error).__name__}: {' '.join(str(error).split())}; run it alone to see where",
            "policy_invalid",
        ) from error
    if not isinstance(policy, ActingPolicy):
        raise ConfigError(
            f"policy {name}: gives {type(policy).__name__}, expected an object with the methods reset() and act(observation)",
            "policy_invalid",
        )
    return policy


def policy_identity(name: str, policy: ActingPolicy) -> list[str]:
    """Returns texts by which two policies of one name differ.

    Args:
        name: Its ``module:function``.
        policy: The policy. Its attribute ``fingerprint``, if it has one, says what the source does not, such as a hash of weights.

    Returns:
        The sources of the modules of the function and of the policy's class, empty where there is none, and the fingerprint.
    """
    modules = (import_module(name.partition(":")[0]), inspect.getmodule(type(policy)))
    return [*map(_source, modules), str(getattr(policy, "fingerprint", ""))]


def _source(module: ModuleType | None) -> str:
    try:
        return "" if module is None else inspect.getsource(module)
    except (OSError, TypeError):
        return ""
