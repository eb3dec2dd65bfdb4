"""Training of the instruction reader on made sentences, of which no two are equal."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from math import cos, pi
from pathlib import Path
from random import Random

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from models.instruction_reader.frames import Frame
from models.instruction_reader.network import CELLS, CHANGES, GOAL, GROUPS, SAID, START, ReaderNetwork, WordTokens
from models.instruction_reader.nouns import NounPools
from models.instruction_reader.sentences import LabelledSentence, ObjectLabels, SentenceMaker
from models.settings import Count, NonNegative, Positive, PositiveCount, Settings, Share
from models.training.checkpoint import load_checkpoint, save_checkpoint
from models.training.distributed import CPU, ProcessContext
from models.training.heap import trim_heap
from stable_data.errors import ConfigError
from stable_data.random_seeds import named_seed

HELD_OUT = 25
"""One frame of this many is in no training, so that validation meets constructions that the network has not seen."""

_IGNORED = -100
_GROUP = 8  # batches of similar lengths that are made together


@dataclass(frozen=True, slots=True)
class ReaderTrainingSettings(Settings):
    """What shapes the weights; ``--set key=value`` or the table ``[train_reader]`` of a TOML file."""

    sentences: PositiveCount = 300_000
    """Sentences of the training."""

    batch: PositiveCount = 32
    """Sentences of a step."""

    learning_rate: Positive = 6e-4
    """Learning rate of the heads."""

    encoder_rate: Positive = 1e-4
    """Learning rate of the encoder's layers; its embeddings are not trained."""

    warm_up: Share = 0.03
    """Share of the steps over which the learning rates grow to their values; afterwards they fall to 0 along a half cosine."""

    weight_decay: NonNegative = 0.01
    """Weight decay of all trained weights."""

    clip: Positive = 1.0
    """Largest norm of a gradient."""

    tag_weight: NonNegative = 3.0
    """Weight of the loss of mentions; the loss of relations at the start has weight 1."""

    goal_weight: NonNegative = 0.5
    """Weight of the loss of relations after the task."""

    said_weight: NonNegative = 0.3
    """Weight of the losses of counts, regions, groups, uses and changes."""

    masked_sentences: Share = 0.0
    """Share of the sentences in which tokens are hidden, so that no frame is recognised by single words."""

    masked_tokens: Share = 0.15
    """Share of the tokens that are hidden in these."""

    favoured: str = ""
    """Names of files of frames, separated by commas, whose frames are drawn more often."""

    favour: PositiveCount = 3
    """How many times as often these are drawn."""

    dropout: Share = 0.0
    """Dropout of the encoder's hidden values."""

    initial: str = ""
    """Weights of a reader from which the training continues; empty: those of the sentence encoder, with new heads."""

    seed: Count = 0
    """Seed of the first weights and of every draw."""

    @property
    def steps(self) -> int:
        """Steps of the training."""
        return max(1, self.sentences // self.batch)

    def rate_at(self, step: int) -> float:
        """Returns the share of the learning rates at a step."""
        warm = self.warm_up * self.steps
        if step < warm:
            return (step + 1) / warm
        return 0.5 * (1 + cos(pi * (step - warm) / max(1.0, self.steps - warm)))


# --- labels -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Targets:
    """Labels of a batch as classes, int64; -100 where there is none.

    Attributes:
        tags: Outside, begin and inside of mentions (0, 1, 2), (B, W).
        spans: First and last word of each mention, (B, M, 2).
        exists: Whether a mention is one, not padding, (B, M) bool.
        said: What is said of each mention, (B, M) by name.
        start: Pairs at the start, (B, M, M).
        goal: Pairs after the task, (B, M, M).
    """

    tags: Tensor
    spans: Tensor
    exists: Tensor
    said: Mapping[str, Tensor]
    start: Tensor
    goal: Tensor


def targets_of(batch: Sequence[LabelledSentence], num_words: int) -> Targets:
    """Returns the labels of sentences.

    Args:
        batch: The sentences.
        num_words: Words of the longest one.
    """
    most = max(1, *(len(s.mentions) for s in batch))
    tags = np.full((len(batch), num_words), _IGNORED)
    spans = np.zeros((len(batch), most, 2), np.int64)
    exists = np.zeros((len(batch), most), bool)
    exists[:, 0] = True  # attention over no mention is not a number
    said = {name: np.full((len(batch), most), _IGNORED) for name in SAID}
    start, goal = (np.full((len(batch), most, most), _IGNORED) for _ in range(2))
    for b, sentence in enumerate(batch):
        tags[b, : len(sentence.words)] = 0
        objects = [k for _, _, k in sentence.mentions]
        facts = {(a, c): START.index(kind) for a, kind, c in sentence.start}
        aims = {(a, c): GOAL.index(kind) for a, kind, c in sentence.goal}
        for i, (first, last, k) in enumerate(sentence.mentions):
            tags[b, first], tags[b, first + 1 : last + 1] = 1, 2
            spans[b, i], exists[b, i] = (first, last), True
            for name, value in _classes(sentence.objects[k]).items():
                said[name][b, i] = value
            for j, other in enumerate(objects):
                if i != j:
                    start[b, i, j] = START.index("same") if k == other else facts.get((k, other), 0)
                    goal[b, i, j] = aims.get((k, other), 0)
    classes = {name: torch.from_numpy(values) for name, values in said.items()}
    tensors = [torch.from_numpy(values) for values in (tags, spans, exists, start, goal)]
    return Targets(tensors[0], tensors[1], tensors[2], classes, tensors[3], tensors[4])


def _classes(one: ObjectLabels) -> dict[str, int]:
    return {
        "count": one.count,
        "region": CELLS.index(one.region),
        "goal_region": CELLS.index(one.goal_region),
        "group": GROUPS.index(one.group),
        "goal_group": GROUPS.index(one.goal_group),
        "is_filled": int(one.is_filled),
        "is_taken": int(one.is_taken),
        "change": CHANGES.index(one.change),
    }


# --- training -----------------------------------------------------------------------------------------------------------------


def split_frames(frames: Sequence[Frame]) -> tuple[list[Frame], list[Frame]]:
    """Returns the frames of the training, and those that are held out: whole constructions, not sentences."""
    held = [frame for k, frame in enumerate(frames) if k % HELD_OUT == HELD_OUT // 2]
    return [frame for k, frame in enumerate(frames) if k % HELD_OUT != HELD_OUT // 2], held


class ReaderTrainer:
    """The training of a reader.

    Args:
        network: The network, with the weights of the sentence encoder.
        tokens: Splits words into the encoder's tokens.
        frames: All frames; :func:`split_frames` says which are trained.
        nouns: The nouns of their slots.
        settings: What shapes the weights.
        identity: What else does, such as a hash of frames and nouns; a checkpoint of another one is refused.
        place: The device.

    Attributes:
        step: Steps so far.
        network: The network.
        place: The device.
    """

    def __init__(
        self,
        network: ReaderNetwork,
        tokens: WordTokens,
        frames: Sequence[Frame],
        nouns: NounPools,
        settings: ReaderTrainingSettings,
        identity: Mapping[str, str],
        place: ProcessContext = CPU,
    ) -> None:
        self.network, self.place, self.step = network.to(place.device), place, 0
        self._tokens, self._settings, self._identity = tokens, settings, dict(identity)
        trained, held = split_frames(frames)
        favoured = set(settings.favoured.split(",")) if settings.favoured else set()
        if strange := sorted(favoured - {frame.source for frame in frames}):
            raise ConfigError(f"favoured: no file of frames is called {strange[0]!r}", "frames_unknown")
        trained += (settings.favour - 1) * [frame for frame in trained if frame.source in favoured]
        self._maker, self._held = SentenceMaker(trained, nouns), SentenceMaker(held or trained, nouns)
        network.encoder.embeddings.requires_grad_(False)
        for name, module in network.encoder.named_modules():
            if isinstance(module, torch.nn.Dropout) and not name.endswith("self.dropout"):  # that of attention costs most
                module.p = settings.dropout
        encoder = [p for p in network.encoder.parameters() if p.requires_grad]
        known = {id(p) for p in network.encoder.parameters()}
        heads = [p for p in network.parameters() if id(p) not in known]
        self._rates = (settings.encoder_rate, settings.learning_rate)
        groups = [{"params": params, "lr": rate} for params, rate in zip((encoder, heads), self._rates, strict=True)]
        self._optimizer = torch.optim.AdamW(groups, weight_decay=settings.weight_decay, fused=True)
        self._batches = lru_cache(maxsize=2)(self._made)

    def train_step(self) -> dict[str, float]:
        """Makes one step and returns its losses."""
        self.network.train()
        share = self._settings.rate_at(self.step)
        for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * share
        torch.manual_seed(named_seed(self._settings.seed, "dropout", self.step))  # a resumed step drops the same values
        number, index = divmod(self.step, _GROUP)
        s = self._settings
        losses = self.losses(self._batches(number)[index], s.masked_sentences)
        weights = {"tags": s.tag_weight, "start": 1.0, "goal": s.goal_weight, "said": s.said_weight}
        loss = torch.stack([weights[name] * part for name, part in losses.items()]).sum()
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), s.clip)
        self._optimizer.step()
        self.step += 1
        trim_heap(self.step)
        return {name: float(part.detach()) for name, part in losses.items()}

    def losses(self, batch: Sequence[LabelledSentence], masked: float = 0.0) -> dict[str, Tensor]:
        """Returns the losses of sentences: per word for mentions, per mention for pairs.

        Args:
            batch: The sentences.
            masked: Share of the sentences in which tokens are hidden.
        """
        device = self.place.device
        inputs = self._tokens.batch([s.words for s in batch])
        if masked:
            chance = self._settings.masked_tokens * (torch.rand(len(batch), 1) < masked)
            inputs = self._tokens.hide(inputs, torch.rand(inputs.ids.shape) < chance)
        inputs = inputs.to(device)
        labels = targets_of(batch, inputs.num_words)
        with torch.autocast(device.type, torch.bfloat16):
            words = self.network.words(inputs)
        words = words.float()
        scores = self.network.mention_scores(words, labels.spans.to(device), labels.exists.to(device))
        num_mentions = max(1, sum(len(s.mentions) for s in batch))
        return {
            "tags": _entropy(self.network.tags(words), labels.tags),
            "start": _entropy(scores.start, labels.start, "sum") / num_mentions,
            "goal": _entropy(scores.goal, labels.goal, "sum") / num_mentions,
            "said": torch.stack([_entropy(scores.said[name], labels.said[name]) for name in SAID]).sum(),
        }

    def _made(self, number: int) -> list[list[LabelledSentence]]:
        """The batches of one group of steps; each has sentences of similar lengths."""
        rng = Random(f"{self._settings.seed}/{number}")  # noqa: S311 - sentences, not secrets
        size = self._settings.batch
        made = sorted((self._maker.make(rng) for _ in range(_GROUP * size)), key=lambda s: len(s.words))
        batches = [made[k * size : (k + 1) * size] for k in range(_GROUP)]
        rng.shuffle(batches)
        return batches

    def held_out(self, count: int) -> list[LabelledSentence]:
        """Returns sentences of the frames that are in no training."""
        rng = Random(f"{self._settings.seed}/held out")  # noqa: S311 - sentences, not secrets
        return [self._held.make(rng) for _ in range(count)]

    @torch.no_grad()
    def validate(self, count: int = 512) -> dict[str, float]:
        """Returns the mean losses of held-out frames."""
        self.network.eval()
        sentences, size = self.held_out(count), self._settings.batch
        found = [self.losses(sentences[k : k + size]) for k in range(0, count, size)]
        return {name: sum(float(one[name]) for one in found) / len(found) for name in found[0]}

    # --- checkpoints ---

    def save(self, path: Path) -> None:
        """Writes a checkpoint."""
        state = {"network": self.network.state_dict(), "optimizer": self._optimizer.state_dict(), "step": self.step}
        save_checkpoint(path, state, self._about())

    def resume(self, path: Path) -> None:
        """Continues from a checkpoint if there is one.

        Raises:
            ConfigError: It cannot be read, or it is of another training.
        """
        state = load_checkpoint(path, self._about(), "network", "optimizer", "step")
        if state is not None:
            self.network.load_state_dict(state["network"])
            self._optimizer.load_state_dict(state["optimizer"])
            self.step = state["step"]

    def _about(self) -> dict[str, object]:
        return {"settings": asdict(self._settings), **self._identity}


def _entropy(found: Tensor, wanted: Tensor, reduction: str = "mean") -> Tensor:
    wanted = wanted.to(found.device)
    return cross_entropy(found.flatten(0, -2), wanted.flatten(), ignore_index=_IGNORED, reduction=reduction)
