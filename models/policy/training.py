"""Training of a policy on the frames of demonstrations: each state, and the actions that followed it."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from models.policy.keyframes import hand_memories, next_key_frames, opening_before
from models.policy.network import PolicyNetwork, PolicyShape
from models.policy.pictures import episode_pictures
from models.policy.sight import Sight
from models.policy.task_frame import TaskFrame
from models.settings import Count, NonNegative, Positive, PositiveCount, Settings, Share
from models.training.checkpoint import load_checkpoint, save_checkpoint
from models.training.distributed import CPU, ProcessContext
from stable_data.errors import ConfigError
from stable_data.random_seeds import named_seed
from stable_data.robot.episode_chunks import EpisodeChunks
from stable_data.robot.episodes import Episode

_RELAXED = 0.05  # share of the loss that all chunks get, so that none dies
_CHOICE = 0.1  # weight of the loss of the scores
_LEAST_SPREAD = 0.02, 1e-4  # smallest scales of inputs and actions
_MOVES = 6  # numbers of an action that move the tool


@dataclass(frozen=True, slots=True)
class PolicyTrainingSettings(Settings):
    """What shapes the weights; ``--set key=value`` or the table ``[train_policy]`` of a TOML file."""

    network: PolicyShape = field(default_factory=PolicyShape)
    """The shape of the network."""

    steps: PositiveCount = 1000
    """Steps of the training."""

    batch: PositiveCount = 256
    """Frames of a step."""

    learning_rate: Positive = 2e-3
    """Largest learning rate."""

    warm_up: Share = 0.05
    """Share of the steps over which the learning rate grows; afterwards it falls to 0 along a half cosine."""

    weight_decay: NonNegative = 0.01
    """Weight decay."""

    clip: Positive = 1.0
    """Largest norm of a gradient."""

    path_weight: NonNegative = 1.0
    """Weight of the error of the path, which is the sum of the moves until each action, beside that of single actions."""

    average: Share = 0.01
    """Share of the newest weights in the moving average that is written."""

    held_out: Share = 0.05
    """Share of the scenes that are not trained on; the errors on them are in the table of the training."""

    max_episodes: Count = 0
    """Demonstrations of the training at most, drawn by the seed: first one of each scene, then a second one, and so on. 0: all."""

    max_actions: Count = 150
    """Longer demonstrations are left out: in them the expert needed several attempts. 0: none is."""

    failures: bool = False
    """Whether failed demonstrations are cloned too."""

    execute: PositiveCount = 8
    """Actions of a chunk that the policy carries out before it plans anew."""

    seed: Count = 0
    """Seed of the first weights, of the demonstrations and of every draw."""

    def check(self) -> None:
        """Refuses more executed actions than there are.

        Raises:
            ConfigError: See above (``setting_invalid``).
        """
        if self.execute > self.network.horizon:
            raise ConfigError(
                f"setting train_policy.execute is {self.execute}, expected at most network.horizon, {self.network.horizon}",
                "setting_invalid",
            )

    def rate_at(self, step: int) -> float:
        """Returns the learning rate of a step."""
        warm = self.warm_up * self.steps
        if step < warm:
            return self.learning_rate * (step + 1) / (warm + 1)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1.0, self.steps - warm)))


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """The frames of some episodes as tensors.

    Attributes:
        sight: What the network sees of the F frames.
        actions: The actions that followed, (F, H, A) float32, task frame.
        is_real: Whether an action is before the end of the episode, (F, H) bool.
        keys: Pose of the tool in the next key frame, and the opening on the way, (F, K) float32, task frame.
        key_inputs: What the network sees of it, (F, L) float32.
    """

    sight: Sight
    actions: Tensor
    is_real: Tensor
    keys: Tensor
    key_inputs: Tensor

    @classmethod
    def of(cls, episodes: Sequence[Episode], shape: PolicyShape) -> "Frames":
        """Returns the frames of episodes, at least one, as a network of a shape sees them."""
        chunks = EpisodeChunks(episodes, shape.horizon)
        batch = chunks.batch(np.arange(len(chunks)))
        frame = TaskFrame(batch["states"], batch["environment_states"], sees_objects=shape.sees_objects)
        positions, rotations = frame.tool_poses
        following = next_key_frames(chunks)
        keys = frame.keys(positions[following], rotations[following], opening_before(chunks, following))
        pictures = np.zeros((len(chunks), 3 * len(shape.cameras), shape.picture_size, shape.picture_size), np.uint8)
        if shape.cameras:
            for number, episode in enumerate(episodes):
                pictures[chunks.episodes == number] = episode_pictures(episode, shape.cameras, shape.picture_size)
        sight = Sight.of(frame, hand_memories(chunks), pictures)
        parts = (frame.from_actions(batch["actions"]), ~batch["is_padding"], keys, frame.key_inputs(keys))
        return cls(sight, *map(torch.from_numpy, parts))

    def chosen(self, rows: Tensor, device: torch.device) -> "Frames":
        """Returns some of them on a device."""
        parts = (self.actions, self.is_real, self.keys, self.key_inputs)
        return Frames(self.sight.chosen(rows, device), *(part[rows].to(device) for part in parts))

    def __len__(self) -> int:
        """Number of frames F."""
        return len(self.actions)


def split_episodes(
    episodes: Sequence[Episode], settings: PolicyTrainingSettings
) -> tuple[list[Episode], list[Episode], dict[str, int]]:
    """Chooses the demonstrations of a training.

    Args:
        episodes: All episodes.
        settings: The settings.

    Returns:
        Those that are trained on, those of held-out scenes, and how many were left out, by reason.

    Raises:
        ConfigError: None is left to train on (``set_empty``).
    """
    good = [e for e in episodes if e.success or settings.failures]
    short = [e for e in good if not settings.max_actions or e.num_steps <= settings.max_actions]
    held = [e for e in short if named_seed("held out", e.scene_id) / 2**48 < settings.held_out]
    names = {e.scene_id for e in held}
    train = _evenly(
        sorted((e for e in short if e.scene_id not in names), key=lambda e: named_seed(settings.seed, e.episode_id, e.seed))
    )
    chosen = train[: settings.max_episodes or len(train)]
    left_out = {
        "left_out_failed": len(episodes) - len(good),
        "left_out_long": len(good) - len(short),
        "left_out_beyond_max_episodes": len(train) - len(chosen),
    }
    if not chosen:
        raise ConfigError(
            f"no demonstration is left of {len(episodes)} episodes ({len(episodes) - len(good)} failed, {len(good) - len(short)} are "
            f"longer than {settings.max_actions} actions, {len(held)} are of held-out scenes), expected at least one",
            "set_empty",
        )
    return chosen, held, left_out


def _evenly(episodes: Sequence[Episode]) -> list[Episode]:
    """The first episode of each scene, then the second of each, and so on."""
    seen: Counter[str] = Counter()
    rounds = []
    for episode in episodes:
        rounds.append(seen[episode.scene_id])
        seen[episode.scene_id] += 1
    return [episodes[k] for k in sorted(range(len(episodes)), key=lambda k: rounds[k])]


class PolicyTrainer:
    """Trains a policy; the same settings and demonstrations give the same weights on one kind of machine.

    Args:
        train: Demonstrations of the training, at least one.
        held_out: Demonstrations of other scenes.
        settings: The settings.
        about: What determines the training, for the checkpoint.
        place: Device of the training.

    Attributes:
        step: Steps done.
        place: The argument.
        network: The network.
        curve: Figures of the training, one row each time they were taken; see :meth:`note`.
    """

    def __init__(
        self,
        train: Sequence[Episode],
        held_out: Sequence[Episode],
        settings: PolicyTrainingSettings,
        about: Mapping[str, Any],
        place: ProcessContext = CPU,
    ) -> None:
        self.step, self.place, self._settings, self._about = 0, place, settings, about
        self.curve: list[dict[str, float]] = []
        torch.manual_seed(named_seed(settings.seed, "weights"))
        self.network = PolicyNetwork(settings.network)
        self._train = Frames.of(train, settings.network)
        self._held_out = Frames.of(held_out, settings.network) if held_out else None
        self._normalise()
        self.network.to(place.device)
        self._average = {name: value.clone() for name, value in self.network.state_dict().items()}
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )
        self._loss_sum = torch.zeros(())
        self._since = 0

    def _normalise(self) -> None:
        network, first = self.network, self._train.actions[:, 0]
        network.input_mean.copy_(self._train.sight.inputs.mean(0))
        network.input_scale.copy_(self._train.sight.inputs.std(0, correction=0).clamp_min(_LEAST_SPREAD[0]))
        network.key_mean.copy_(self._train.keys.mean(0))
        network.key_scale.copy_(self._train.keys.std(0, correction=0).clamp_min(_LEAST_SPREAD[0]))
        network.action_mean[_MOVES:] = first.mean(0)[_MOVES:]  # no move stays no move
        network.action_scale.copy_((first - network.action_mean).square().mean(0).sqrt().clamp_min(_LEAST_SPREAD[1]))

    def train_step(self) -> dict[str, float]:
        """Makes a step; returns the losses."""
        settings, network, device = self._settings, self.network, self.place.device
        torch.manual_seed(named_seed(settings.seed, "step", self.step))  # so that a resumed training draws the same
        rows = torch.randint(len(self._train), (settings.batch,))
        frames = self._train.chosen(rows, device)
        for group in self._optimizer.param_groups:
            group["lr"] = settings.rate_at(self.step)
        network.train()
        seen = network.see(frames.sight)
        where, how = key_loss(network, seen, frames), chunk_loss(network, seen, frames, settings.path_weight)
        loss = where + how
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip)
        self._optimizer.step()
        share = max(settings.average, 1 / (self.step + 1))  # at the start the mean of all
        with torch.no_grad():
            for name, value in network.state_dict().items():
                self._average[name].lerp_(value, share)
        self.step += 1
        found = float(loss.detach())
        self._loss_sum += found
        self._since += 1
        return {"where": float(where.detach()), "how": float(how.detach())}

    def note(self) -> dict[str, float]:
        """Adds a row to the curve: the mean loss since the last row, and the errors of the first action in held-out scenes."""
        row = {"step": float(self.step), "loss": float(self._loss_sum) / max(1, self._since)}
        row |= held_out_errors(self.averaged(), self._held_out)
        self._loss_sum, self._since = torch.zeros(()), 0
        self.curve.append(row)
        return row

    def averaged(self) -> PolicyNetwork:
        """Returns the network with the averaged weights, on the CPU, for use."""
        network = PolicyNetwork(self._settings.network)
        network.load_state_dict(self._average)
        return network.eval()

    def save(self, path: Path) -> None:
        """Writes a checkpoint."""
        state = {
            "step": self.step,
            "network": self.network.state_dict(),
            "average": self._average,
            "optimizer": self._optimizer.state_dict(),
            "curve": self.curve,
            "since": (float(self._loss_sum), self._since),
        }
        save_checkpoint(path, state, self._about)

    def resume(self, path: Path) -> None:
        """Continues from a checkpoint, if there is one.

        Raises:
            ConfigError: It cannot be read, or is of another training.
        """
        state = load_checkpoint(path, self._about, "step", "network", "average", "optimizer", "curve", "since")
        if state is None:
            return
        self.step, self.curve = state["step"], list(state["curve"])
        self.network.load_state_dict(state["network"])
        self._average = {name: value.clone().to(self.place.device) for name, value in state["average"].items()}
        self._optimizer.load_state_dict(state["optimizer"])
        self._loss_sum, self._since = torch.tensor(state["since"][0]), state["since"][1]


def key_loss(network: PolicyNetwork, seen: Tensor, frames: Frames) -> Tensor:
    """Returns the loss of where the hand opens or closes next: that of the best proposal, and of the scores that shall find it.

    Proposals of the point that is nearest to the demonstrated place count.

    Args:
        network: The network.
        seen: What it sees, see :meth:`PolicyNetwork.see`.
        frames: The frames.
    """
    keys, scores = network.keys(seen, frames.sight.points)
    wanted = (frames.keys - network.key_mean) / network.key_scale
    nearest = (frames.sight.points[..., :3] - frames.keys[:, None, :3]).square().sum(-1).argmin(dim=1)
    rows = torch.arange(len(keys))
    each = (keys[rows, nearest] - wanted[:, None]).abs().mean(-1)  # (B, M)
    best = each.detach().argmin(dim=1)
    chosen = each[rows, best]
    labels = nearest * each.shape[1] + best
    return ((1 - _RELAXED) * chosen + _RELAXED * each.mean(1)).mean() + _CHOICE * cross_entropy(scores.flatten(1), labels)


def chunk_loss(network: PolicyNetwork, seen: Tensor, frames: Frames, path_weight: float) -> Tensor:
    """Returns the loss of the actions on the way to the next key frame.

    Args:
        network: The network.
        seen: What it sees, see :meth:`PolicyNetwork.see`.
        frames: The frames.
        path_weight: Weight of the error of the path.
    """
    is_real = frames.is_real.float()[..., None]
    wanted = (frames.actions - network.action_mean) / network.action_scale
    errors = (network.chunks(seen, frames.key_inputs) - wanted) * is_real  # (B, H, A)
    path = errors[..., :_MOVES].cumsum(dim=1) * is_real / math.sqrt(errors.shape[1])
    return (errors.abs().mean(-1).sum() + path_weight * path.abs().mean(-1).sum()) / is_real.sum()


@torch.no_grad()
def held_out_errors(network: PolicyNetwork, frames: Frames | None) -> dict[str, float]:
    """Returns mean errors: of the first action, given the next key frame, and of the key frame itself; NaN without frames."""
    names = ("move_mm", "turn_deg", "opening_mm", "key_mm", "key_deg")
    if frames is None:
        return dict.fromkeys(names, math.nan)
    seen = network.see(frames.sight)
    away = network.actions(seen, frames.key_inputs)[:, 0] - frames.actions[:, 0]
    chosen = network.best(*network.keys(seen, frames.sight.points))
    facing = torch.cosine_similarity(chosen[:, 6:9], frames.keys[:, 6:9], dim=1).clamp(-1, 1)  # of the closing directions
    return {
        "move_mm": 1e3 * float(away[:, :3].norm(dim=1).mean()),
        "turn_deg": math.degrees(float(away[:, 3:_MOVES].norm(dim=1).mean())),
        "opening_mm": 1e3 * float(away[:, _MOVES].abs().mean()),
        "key_mm": 1e3 * float((chosen - frames.keys)[:, :3].norm(dim=1).mean()),
        "key_deg": math.degrees(float(facing.acos().mean())),
    }
