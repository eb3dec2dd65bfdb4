"""Settings of the reasoner's training, and presets."""

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal, TypeAlias

from annotated_types import Ge, MultipleOf

from models.semantic_reasoner.text.prompt import WANTED
from models.settings import Count, NonNegative, Positive, PositiveCount, Settings, Share
from stable_data.config_diff import flatten_config
from stable_data.errors import ConfigError

Precision: TypeAlias = Literal["bfloat16", "float32"]
Optimizer: TypeAlias = Literal["adamw", "muon"]


@dataclass(frozen=True, slots=True)
class LanguageModelSettings(Settings):
    """A Qwen3 that is trained from scratch."""

    hidden: PositiveCount = 256
    """Width of the residual stream."""

    layers: PositiveCount = 6
    """Transformer blocks."""

    heads: PositiveCount = 4
    """Query heads."""

    key_value_heads: PositiveCount = 2
    """Key and value heads, shared by the query heads."""

    head: Annotated[int, Ge(1), MultipleOf(2)] = 64
    """Width of a head. Queries and keys are normalised, so attention of a narrow head is less sharp: with 64 the model learns
    to copy a number in fewer steps than with 32.
    """

    intermediate: PositiveCount = 704
    """Width of the gated feed-forward layer."""

    vocabulary: PositiveCount = 2560
    """Tokens for words; the tokens of layouts and of the prompt are added to them."""

    def check(self) -> None:
        """Refuses heads that cannot be shared; see the base class."""
        if self.heads % self.key_value_heads:
            found = f"heads {self.heads}, key_value_heads {self.key_value_heads}"
            raise ConfigError(f"network: {found}: expected as many heads or a multiple of them", "config_invalid")


@dataclass(frozen=True, slots=True)
class LoraSettings(Settings):
    """Low-rank matrices beside the linear layers of ``base``, trained instead of its weights."""

    rank: Count = 0
    """Rank of the matrices; 0 trains the weights themselves."""

    alpha: PositiveCount = 32
    """Scale of the matrices' product: it counts ``alpha / rank`` times."""

    merges: bool = True
    """Whether the saved weights are a whole model; else they are an adapter beside ``base``, as peft reads it."""


@dataclass(frozen=True, slots=True)
class StageShares(Settings):
    """Which share of the examples of each kind a pass takes, drawn anew each time."""

    task: Share = 1.0
    """Share of the examples of O^t that a pass takes, drawn anew each pass; so are the other shares."""

    important: Share = 1.0
    """Share of the examples of O^B."""

    secondary: Share = 1.0
    """Share of the examples of O^b."""

    whole: Share = 0.0
    """Share of the examples of whole layouts in one reply, which are made of the last stages. The paper's one-shot ablation is
    a training on these alone.
    """

    edit: Share = 1.0
    """Share of the examples of edits."""

    def of_kinds(self) -> tuple[float, ...]:
        """Returns the shares in the order of :data:`WANTED`."""
        return tuple(getattr(self, str(kind)) for kind in WANTED)


@dataclass(frozen=True, slots=True)
class ReasonerTrainingSettings(Settings):
    """What shapes the weights; ``--set key=value`` or the table ``[train_reasoner]`` of a TOML file."""

    base: str = ""
    """Folder of a Hugging Face model to fine-tune; empty trains ``network`` from scratch."""

    tokenizer: str = ""
    """Folder of a tokenizer with a chat template. Empty takes that of ``base``; without ``base`` a tokenizer is trained."""

    edits: str = ""
    """Run folder whose table ``edits`` is learned from beside ``samples``; empty takes the run's own, where it has one. Not
    read where ``shares.edit`` is 0.
    """

    seed: Count = 0
    """Seed of the first weights and of every draw."""

    steps: Count = 0
    """Optimizer steps; 0 takes ``passes``."""

    passes: NonNegative = 1.0
    """Passes over the examples; read where ``steps`` is 0."""

    tokens_per_batch: PositiveCount = 6144
    """Tokens of a batch, at most, padding included; a batch has one row at least."""

    rows_per_batch: Count = 0
    """Rows of a batch, at most; 0 sets no bound."""

    accumulate: PositiveCount = 1
    """Batches whose gradients add up to a step. Processes share a step by its batches, so that its examples do not depend on
    the number of processes, which must divide this number.
    """

    max_tokens: PositiveCount = 2048
    """Tokens; the longest example. Longer ones are left out and counted. Also the width of a packed row."""

    packs: bool = False
    """Whether a row holds several examples that do not attend to each other; else each example has its own row in a batch of
    similar lengths, which is faster on a CPU.
    """

    optimizer: Optimizer = "adamw"
    """Optimizer of the matrices between embeddings and head; AdamW trains all else. Muon takes fewer steps to the same loss
    where a small network is trained from scratch.
    """

    learning_rate: Positive = 1.5e-3
    """Learning rate of both optimizers."""

    warm_up: Count = 200
    """Steps over which the learning rate grows to its value."""

    cool_down: Share = 0.3
    """Share of the steps, the last ones, over which the learning rate falls to 0."""

    weight_decay: NonNegative = 0.05
    """Weight decay of matrices."""

    clip: Positive = 1.0
    """Largest norm of a gradient."""

    any_table_share: Share = 0.2
    """Share of the examples that do not say the kind of table, so that a model learns to use its size."""

    part_share: Share = 0.0
    """Share of the examples that show a part of their table as a table of its own, so that a model trained on large tables can
    fill a small one.
    """

    required_share: Share = 0.0
    """Share of the examples of O^t and of whole layouts that state the required objects and relations in canonical form, as the
    reading of an instruction gives them. A model that was trained on some is asked so.
    """

    with_details: bool = False
    """Whether the prompt also holds the rest of the task info."""

    precision: Precision = "bfloat16"
    """Number format of matrix products, in several processes also of the layers while they are gathered; trained weights, their
    gradients and averages are float32.
    """

    storage: Precision = "float32"
    """Number format of the saved weights."""

    recomputes: bool = False
    """Whether the backward pass computes activations again, which saves memory (gradient checkpointing)."""

    compiles: bool = False
    """Whether ``torch.compile`` compiles the network. It needs a C++ compiler and a minute, and one process; the small network
    then trains half as many tokens a second again on a CPU. A resumed run is then equal up to rounding, not to the byte.
    """

    shares: StageShares = field(default_factory=StageShares)
    """Which share of the examples of each stage a pass takes."""

    network: LanguageModelSettings = field(default_factory=LanguageModelSettings)
    """The network that is trained from scratch, where ``base`` is empty."""

    lora: LoraSettings = field(default_factory=LoraSettings)
    """Low-rank matrices that are trained in place of the weights of ``base``."""

    def check(self) -> None:
        """Refuses a run without steps, and an adapter without its model; see the base class."""
        if self.steps + self.passes == 0:
            raise ConfigError("steps and passes are 0, expected one of them to be more", "config_invalid")
        if self.lora.rank and not self.base:
            raise ConfigError("lora.rank is set but base is empty, expected the model that it adapts", "config_invalid")

    def resolved(self, num_batches: int) -> "ReasonerTrainingSettings":
        """Returns the settings with ``steps`` set, for a number of batches of a pass."""
        return replace(self, steps=self.steps or max(1, math.ceil(self.passes * num_batches / self.accumulate)))

    def learning_rate_at(self, step: int) -> float:
        """Returns the learning rate at a step, with ``steps`` set: it grows, is constant, and falls to 0."""
        grown = min(1.0, (step + 1) / self.warm_up) if self.warm_up else 1.0
        last = self.cool_down * self.steps
        left = min(1.0, (self.steps - step) / last) if last else 1.0
        return self.learning_rate * grown * left

    def flat(self) -> dict[str, Any]:
        """Returns every setting by its dotted key."""
        return flatten_config(asdict(self))


EMBEDDED = ReasonerTrainingSettings(
    optimizer="muon",
    learning_rate=3e-3,
    part_share=0.4,
    shares=StageShares(important=0.2, secondary=0.12, whole=0.1, edit=0.1),
)
"""The small model of the embedded engine: from scratch, with its own tokenizer, on one core of a CPU.

The first stage decides the content of a scene and is the hardest, so it has the largest share. An edit has a long question and
a short answer, 374 and 28 tokens in the embedded world, against 37 and 58 of a first stage, so its share is small."""

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

The paper states neither the number of GPUs nor the schedule: here ``accumulate`` is 8 micro-batches a step, such as one on each
of 8 GPUs, and the rate is constant. There are no edits. Set ``base`` to the model's folder."""

_PRESETS = {"embedded": EMBEDDED, "paper": PAPER}


def training_preset(name: str) -> ReasonerTrainingSettings:
    """Returns a preset by name.

    Raises:
        ConfigError: The name is unknown (``config_invalid``).
    """
    if name not in _PRESETS:
        raise ConfigError(f"reasoner preset {name!r} is not known, expected {' or '.join(_PRESETS)}", "config_invalid")
    return _PRESETS[name]
