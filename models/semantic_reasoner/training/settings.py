"""Settings of the reasoner's training, and the named ones."""

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, TypeAlias

from models.semantic_reasoner.text.prompt import WANTED
from stable_data.config_diff import flat
from stable_data.errors import ConfigError

Precision: TypeAlias = Literal["bfloat16", "float32"]
Optimizer: TypeAlias = Literal["adamw", "muon"]


@dataclass(frozen=True, slots=True)
class LanguageModelSettings:
    """A Qwen3 that is trained from scratch.

    Attributes:
        hidden: Width of the residual stream.
        layers: Transformer blocks.
        heads: Query heads.
        key_value_heads: Key and value heads, shared by the query heads.
        head: Width of a head. Queries and keys are normalised, so a narrow head looks less sharply: with 64 copying a number is
            learned in fewer steps than with 32.
        intermediate: Width of the gated feed-forward layer.
        vocabulary: Tokens for words; those of layouts and of the prompt come beside them.
    """

    hidden: int = 256
    layers: int = 6
    heads: int = 4
    key_value_heads: int = 2
    head: int = 64
    intermediate: int = 704
    vocabulary: int = 2560

    def __post_init__(self) -> None:
        """Refuses what is no network."""
        for key, value in asdict(self).items():
            if value < 1:
                raise ConfigError(f"network.{key} is {value}, expected a positive number", "config_invalid")
        if self.heads % self.key_value_heads or self.head % 2:
            found = f"heads {self.heads}, key_value_heads {self.key_value_heads}, head {self.head}"
            raise ConfigError(
                f"network: {found}: expected as many heads or a multiple of them, and an even width", "config_invalid"
            )


@dataclass(frozen=True, slots=True)
class LoraSettings:
    """Low-rank matrices beside the linear layers of ``base``, trained instead of its weights.

    Attributes:
        rank: Of the matrices; 0 trains the weights themselves.
        alpha: Their product counts ``alpha / rank``.
        merges: Whether the weights that are kept are a model of their own; else an adapter beside ``base``, as peft reads it.
    """

    rank: int = 0
    alpha: int = 32
    merges: bool = True

    def __post_init__(self) -> None:
        """Refuses what cannot run."""
        if self.rank < 0 or self.alpha < 1:
            raise ConfigError(
                f"lora: rank {self.rank}, alpha {self.alpha}: expected 0 or more, and 1 or more", "config_invalid"
            )


@dataclass(frozen=True, slots=True)
class StageShares:
    """Which share of the examples of each kind a pass takes, drawn anew each time.

    Attributes:
        task: O^t.
        important: O^B.
        secondary: O^b.
        whole: Whole layouts in one pass, made of the last stages. The paper's one-shot ablation is a training of these alone.
        edit: Edits.
    """

    task: float = 1.0
    important: float = 1.0
    secondary: float = 1.0
    whole: float = 0.0
    edit: float = 1.0

    def of_kinds(self) -> tuple[float, ...]:
        """In the order of the prompt's kinds."""
        return tuple(getattr(self, str(kind)) for kind in WANTED)


@dataclass(frozen=True, slots=True)
class ReasonerTrainingSettings:
    """What shapes the weights; ``--set key=value`` or the table ``[train_reasoner]`` of a TOML file.

    Attributes:
        base: Folder of a Hugging Face model to fine-tune; empty trains ``network`` from scratch.
        tokenizer: Folder of a tokenizer with a chat template; empty takes that of ``base``, or without one trains its own.
        edits: Run folder whose table ``edits`` is learned from beside ``samples``; empty takes the run's own, where it has one.
            It is not read where ``shares.edit`` is 0.
        seed: Of the first weights and of every draw.
        steps: Length of the run; 0 takes ``passes``.
        passes: Length in passes over the examples.
        tokens_per_batch: Most tokens of a batch, padding included; a batch has one row at least.
        rows_per_batch: Most rows of a batch; 0 is no bound.
        accumulate: Batches whose gradients add up to a step. Processes share a step by its batches, so that its examples do not
            depend on their number, which must divide this one.
        max_tokens: Longest example; longer ones are left out and counted. Also the width of a row that is packed.
        packs: Whether a row has several examples, each blind to the others; else each has a row of its own beside others of
            like length, which is faster on a CPU.
        optimizer: Of the matrices between embeddings and head; all else is AdamW's. Muon takes fewer steps to the same loss
            where a small network is trained from scratch.
        learning_rate: Of either.
        warm_up: Steps over which it grows to that.
        cool_down: Share of the steps, the last ones, over which it falls to 0.
        weight_decay: Of matrices.
        clip: Largest norm of a gradient.
        any_table_share: Share of the examples whose kind of table is not said, so that a model learns to go by its size.
        part_share: Share of the examples that show a part of their table as a table of its own, likewise, so that a model that
            has seen large tables alone can lay out a small one.
        with_details: Whether the rest of the task info is said too.
        precision: Of multiplications; weights, norms, gradients and averages are float32.
        storage: Of the weights that are kept in the end.
        recomputes: Whether activations are computed again in the backward pass instead of kept (gradient checkpointing).
        compiles: Whether the network is compiled first (``torch.compile``), which takes a C++ compiler and a minute and gains
            half as many tokens a second again with the small network on a CPU. One process, and a run that was resumed is then
            the run that was not up to rounding, not to the byte.
        shares: Of the stages.
        network: Where ``base`` is empty.
        lora: Trains little of ``base``.
    """

    base: str = ""
    tokenizer: str = ""
    edits: str = ""
    seed: int = 0
    steps: int = 0
    passes: float = 1.0
    tokens_per_batch: int = 6144
    rows_per_batch: int = 0
    accumulate: int = 1
    max_tokens: int = 2048
    packs: bool = False
    optimizer: Optimizer = "adamw"
    learning_rate: float = 1.5e-3
    warm_up: int = 200
    cool_down: float = 0.3
    weight_decay: float = 0.05
    clip: float = 1.0
    any_table_share: float = 0.2
    part_share: float = 0.0
    with_details: bool = False
    precision: Precision = "bfloat16"
    storage: Precision = "float32"
    recomputes: bool = False
    compiles: bool = False
    shares: StageShares = field(default_factory=StageShares)
    network: LanguageModelSettings = field(default_factory=LanguageModelSettings)
    lora: LoraSettings = field(default_factory=LoraSettings)

    def __post_init__(self) -> None:
        """Refuses what cannot run."""
        for key in ("tokens_per_batch", "accumulate", "max_tokens", "learning_rate", "clip"):
            if not 0 < getattr(self, key) < math.inf:
                raise ConfigError(f"{key} is {getattr(self, key)}, expected a positive number", "config_invalid")
        least = min(self.steps, self.passes, self.warm_up, self.rows_per_batch, self.weight_decay, self.seed)
        if not (least >= 0 and self.steps + self.passes > 0):
            found = f"steps {self.steps}, passes {self.passes}, warm_up {self.warm_up}, rows_per_batch {self.rows_per_batch}"
            raise ConfigError(
                f"{found}, weight_decay {self.weight_decay}, seed {self.seed}: expected a length, and nothing negative",
                "config_invalid",
            )
        shares = self.shares.of_kinds()
        if not all(0 <= share <= 1 for share in (self.cool_down, self.any_table_share, self.part_share, *shares)):
            raise ConfigError(
                "cool_down, any_table_share, part_share and shares: expected shares between 0 and 1", "config_invalid"
            )
        if self.lora.rank and not self.base:
            raise ConfigError("lora.rank is set but base is empty, expected the model that it adapts", "config_invalid")

    def resolved(self, num_batches: int) -> "ReasonerTrainingSettings":
        """The same with ``steps`` set.

        Args:
            num_batches: Of a pass.
        """
        return replace(self, steps=self.steps or max(1, math.ceil(self.passes * num_batches / self.accumulate)))

    def learning_rate_at(self, step: int) -> float:
        """The learning rate at a step of a run whose ``steps`` is set: it grows, stays, and falls to 0."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        last = self.cool_down * self.steps
        left = min(1.0, (self.steps - step) / last) if last else 1.0
        return self.learning_rate * grown * left

    def flat(self) -> dict[str, Any]:
        """Every setting by its dotted key."""
        return flat(asdict(self))


EMBEDDED = ReasonerTrainingSettings(
    optimizer="muon",
    learning_rate=3e-3,
    part_share=0.4,
    shares=StageShares(important=0.2, secondary=0.12, whole=0.1, edit=0.1),
)
"""The small model of the embedded engine: from scratch, with a tokenizer of its own, on one core of a CPU.

The first stage decides what a scene is about and is the hardest to get right, so it is shown most. An edit is a long question
and a short answer, 374 tokens and 28 on the embedded world, against 37 and 58 of a first stage, so few of them are shown."""

PAPER = ReasonerTrainingSettings(
    learning_rate=1e-5,
    max_tokens=5000,
    tokens_per_batch=4 * 5000,
    rows_per_batch=4,
    accumulate=8,
    passes=1.0,
    warm_up=0,
    cool_down=0.0,
    weight_decay=0.0,
    any_table_share=0.0,
    storage="bfloat16",
    recomputes=True,
    shares=StageShares(edit=0.0),
)
"""The paper's Appendix "Training Details": full-parameter fine-tuning of Qwen3-8B, 1e-5, 5,000 tokens, micro-batches of 4, 1 epoch.

It says neither on how many GPUs nor with which schedule: ``accumulate`` is 8 micro-batches a step, such as one on each of 8
GPUs, and the rate is constant. Nothing is learned of edits. ``base`` is yours to name."""

_PRESETS = {"embedded": EMBEDDED, "paper": PAPER}


def training_preset(name: str) -> ReasonerTrainingSettings:
    """Named settings.

    Raises:
        ConfigError: There are none of that name.
    """
    if name not in _PRESETS:
        raise ConfigError(f"reasoner preset {name!r} is not known, expected {' or '.join(_PRESETS)}", "config_invalid")
    return _PRESETS[name]
