"""Settings of the reasoner's training, and the named ones."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from models.semantic_reasoner.prompt import WANTED
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """A Qwen3 that is trained from scratch.

    Attributes:
        hidden: Width of the residual stream.
        layers: Transformer blocks.
        heads: Query heads.
        key_value_heads: Key and value heads, shared by the query heads.
        head: Width of a head.
        intermediate: Width of the gated feed-forward layer.
        vocabulary: Tokens for words; those of layouts and of the prompt come beside them.
    """

    hidden: int = 256
    layers: int = 6
    heads: int = 8
    key_value_heads: int = 2
    head: int = 32
    intermediate: int = 704
    vocabulary: int = 2560


@dataclass(frozen=True, slots=True)
class StageShares:
    """Which share of the examples of each kind a pass takes, drawn anew each time."""

    task: float = 1.0
    important: float = 1.0
    secondary: float = 1.0
    whole: float = 1.0
    edit: float = 1.0

    def of_kinds(self) -> tuple[float, ...]:
        """In the order of the prompt's kinds."""
        return tuple(getattr(self, str(kind)) for kind in WANTED)


@dataclass(frozen=True, slots=True)
class ReasonerTraining:
    """What shapes the weights; ``--set key=value`` or the table ``[train_reasoner]`` of a TOML file.

    Attributes:
        base: Folder of a Hugging Face model to fine-tune; empty trains ``network`` from scratch with a tokenizer of its own.
        seed: Of the first weights and of every draw.
        steps: Length of the run; 0 takes ``passes``.
        passes: Length in passes over the examples.
        tokens_per_batch: Of a step on each process, padding included.
        accumulate: Batches whose gradients add up to a step.
        max_tokens: Longest example; longer ones are left out and counted.
        packs: Whether a row has several examples, each blind to the others; else each has a row of its own beside others of
            like length, which is faster on a CPU.
        learning_rate: Of AdamW.
        warm_up: Steps over which it grows to that.
        cool_down: Share of the steps, the last ones, over which it falls to 0.
        weight_decay: Of matrices.
        clip: Largest norm of a gradient.
        any_table_share: Share of the examples whose kind of table is not said, so that a model learns to go by its size.
        with_details: Whether the rest of the task info is said too.
        one_shot: The paper's ablation: the whole layout in one pass.
        shares: Of the stages.
        network: Where ``base`` is empty.
    """

    base: str = ""
    seed: int = 0
    steps: int = 0
    passes: float = 1.0
    tokens_per_batch: int = 6144
    accumulate: int = 1
    max_tokens: int = 2048
    packs: bool = False
    learning_rate: float = 1.5e-3
    warm_up: int = 200
    cool_down: float = 0.3
    weight_decay: float = 0.05
    clip: float = 1.0
    any_table_share: float = 0.2
    with_details: bool = False
    one_shot: bool = False
    shares: StageShares = field(default_factory=StageShares)
    network: NetworkSettings = field(default_factory=NetworkSettings)

    def __post_init__(self) -> None:
        """Refuses what cannot run."""
        for key in ("tokens_per_batch", "accumulate", "max_tokens", "learning_rate", "clip"):
            if not 0 < getattr(self, key) < math.inf:
                raise ConfigError(f"{key} is {getattr(self, key)}, expected a positive number", "config_invalid")
        if not (min(self.steps, self.passes, self.warm_up) >= 0 and self.steps + self.passes > 0):
            raise ConfigError(f"steps {self.steps}, passes {self.passes}: expected a length", "config_invalid")
        if not (0 <= self.cool_down <= 1 and 0 <= self.any_table_share <= 1 and min(self.shares.of_kinds()) >= 0):
            raise ConfigError("cool_down, any_table_share and shares: expected shares between 0 and 1", "config_invalid")

    def learning_rate_at(self, step: int) -> float:
        """AdamW's learning rate at a step of a run whose ``steps`` is set: it grows, stays, and falls to 0."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        last = self.cool_down * self.steps
        left = min(1.0, (self.steps - step) / last) if last else 1.0
        return self.learning_rate * grown * left

    def flat(self) -> dict[str, Any]:
        """Every setting by its dotted key."""
        from models.physics_corrector.training_settings import flattened

        return flattened(asdict(self))


Preset = Literal["paper", "embedded"]
