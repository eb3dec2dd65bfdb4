"""A few questions and answers, a tokenizer of their words, and networks that are small enough to train in a test."""

from dataclasses import replace
from functools import cache

from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject
from models.semantic_reasoner.text.tokenizer import train_tokenizer
from models.semantic_reasoner.training.examples import TrainingExample
from models.semantic_reasoner.training.settings import LanguageModelSettings, ReasonerTrainingSettings
from models.semantic_reasoner.training.token_dataset import TokenDataset, tokenize_examples
from stable_data.scene import Stage, Tabletop

TINY = ReasonerTrainingSettings(
    steps=8,
    tokens_per_batch=400,
    max_tokens=512,
    warm_up=2,
    learning_rate=1e-2,
    precision="float32",
    network=LanguageModelSettings(hidden=32, layers=2, heads=4, key_value_heads=2, head=8, intermediate=64, vocabulary=300),
)
TABLE = Tabletop("office_table", (1.2, 0.6), None)
WORDS = ("red mug", "white plate", "green bottle", "small lamp", "black pen", "old book", "tin box", "round bowl")


def thing(number: int) -> LayoutObject:
    words = WORDS[number % len(WORDS)]
    x = 10.0 + 7.5 * (number % 12)
    return LayoutObject(f"{words.split()[1]}_0", words, (8.0, 8.0, 10.0), (x, 30.0, 5.0), 15 * (number % 20) - 140)


def examples(count: int) -> list[TrainingExample]:
    """Questions of the three stages in turn; replies get longer with the number."""
    made = []
    for k in range(count):
        stage = list(Stage)[k % 3]
        layout = () if stage is Stage.TASK else (thing(k), thing(k + 1))
        ask = ReasonerQuestion(f"Move the {WORDS[k % len(WORDS)]} to place {k}", TABLE, stage, layout)
        made.append(TrainingExample(f"scene_{k}", ask, tuple(thing(k + 2 + n) for n in range(1 + k % 4))))
    return made


@cache
def tokenizer() -> PreTrainedTokenizerBase:
    texts = [text for e in examples(24) for text in (e.prompt[-1]["content"], e.answer)]
    return train_tokenizer(texts, TINY.network.vocabulary)


def token_set(count: int) -> TokenDataset:
    return tokenize_examples(examples(count), tokenizer(), TINY.max_tokens)


PACKED = replace(TINY, packs=True)
