"""A tokenizer for layouts: the fixed parts of the prompt, the punctuation of its JSON and its numbers are single tokens.

An object with a description of six words has about 25 tokens, with a general tokenizer about 90. Words are byte-level BPE
trained on the samples, so that any text can be encoded, with more tokens.
"""

import re
from collections.abc import Iterable, Sequence

from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers import PreTrainedTokenizerBase, PreTrainedTokenizerFast

from models.semantic_reasoner.text.prompt import FIXED, Message

PAD, SYSTEM, USER, ASSISTANT, END = "<|pad|>", "<|system|>", "<|user|>", "<|assistant|>", "<|end|>"
_SPECIAL = (PAD, SYSTEM, USER, ASSISTANT, END)

MAX_WHOLE_CM = 200
"""Whole centimetres up to this number are one token."""

_MAX_NUMBER = 24  # running numbers of a category below this one are one token

CHAT_TEMPLATE = (
    "{% for m in messages %}{% if m.role == 'system' %}<|system|>{{ m.content }}"
    "{% elif m.role == 'user' %}<|user|>{{ m.content }}"
    "{% else %}<|assistant|>{{ m.content }}<|end|>{% endif %}{% endfor %}"
    "{% if add_generation_prompt %}<|assistant|>{% endif %}"
)
"""The chat template in Jinja, as transformers and vLLM read it."""


def scaffolding() -> tuple[str, ...]:
    """Returns the texts between the words of a layout's JSON, each of which is one token."""
    opening = '"objects":[{"instance":"'
    return (
        "{" + opening,
        '{"objects":[]}',
        '},{"instance":"',
        "}]}",
        '","size":[',
        *(f'_{n}","description":"' for n in range(_MAX_NUMBER)),
        *(f".{d}{after}" for d in range(10) for after in ("", ",", '],"position":[', '],"z_rotation":', "]")),
        '{"remove":[' + "]," + opening,
        '{"remove":["',
        '","',
        '"],' + opening,
        '"],"objects":[]}',
        *(f"_{n}" for n in range(_MAX_NUMBER)),
        *map(str, range(MAX_WHOLE_CM + 1)),
        *(f"-{n}" for n in range(1, 181)),
    )


def train_tokenizer(texts: Iterable[str], vocab_size: int = 2048) -> PreTrainedTokenizerFast:
    """Trains a tokenizer for layouts.

    Args:
        texts: Questions and answers, as :mod:`models.semantic_reasoner.text.prompt` writes them.
        vocab_size: Tokens for words; those of the punctuation, the numbers and the prompt are added to them.

    Returns:
        The tokenizer, with its chat template.
    """
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(r" ?[A-Za-z_]+| ?[^A-Za-z_\s]|\s+"), "isolated"),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=vocab_size,
        min_frequency=4,
        special_tokens=[AddedToken(text, normalized=False, special=True) for text in _SPECIAL],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    fixed = (*FIXED, *scaffolding())
    # The fixed parts are removed first, so that BPE spends no vocabulary on them. Longer ones come first in the pattern, since
    # some contain others.
    cut = re.compile("|".join(map(re.escape, sorted(fixed, key=len, reverse=True))))
    tokenizer.train_from_iterator((words for text in texts for words in cut.split(text)), trainer)
    tokenizer.add_tokens([AddedToken(text, normalized=False) for text in fixed])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token=PAD,
        eos_token=END,
        chat_template=CHAT_TEMPLATE,
        clean_up_tokenization_spaces=False,
    )


def chat_text(tokenizer: PreTrainedTokenizerBase, messages: Sequence[Message], thinks: bool = False) -> str:
    """Returns the text of a chat up to the answer, in training and at inference.

    Args:
        tokenizer: With a chat template.
        messages: The chat.
        thinks: Whether a chain of thought may precede the answer.
    """
    # Qwen3's own template opens a chain of thought unless thinking is disabled.
    text = tokenizer.apply_chat_template(list(messages), add_generation_prompt=True, enable_thinking=thinks, tokenize=False)
    return str(text)
