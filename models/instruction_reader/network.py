"""The network: a sentence encoder with heads for mentions, for what is said of each, and for relations between two."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from tokenizers import Tokenizer
from torch import Tensor, nn
from torch.nn.functional import pad
from transformers import BertConfig

from models.instruction_reader.phrases import REGIONS

START = ("none", "in", "on", "left", "front", "near", "between", "part", "same")
"""Classes of an ordered pair of mentions at the start; ``same`` means one object, and ``part`` some of a plural."""

GOAL = ("none", "in", "on", "left", "front", "near", "between", "replace", "style", "swap")
"""Classes of an ordered pair of mentions after the task."""

CELLS = ("", *REGIONS.values())
GROUPS = ("", "stack", "nest", "row", "file")
CHANGES = ("", "remove", "add", "away")

SAID: Mapping[str, int] = {
    "count": 9,
    "region": len(CELLS),
    "goal_region": len(CELLS),
    "group": len(GROUPS),
    "goal_group": len(GROUPS),
    "is_filled": 2,
    "is_taken": 2,
    "change": len(CHANGES),
}
"""What is said of a mention, with the number of classes."""

_WIDTH = 256  # of the representations of mentions
_PAIR = 192  # of the representations of pairs
_MOST_BETWEEN = 14  # words between two mentions; more count as this many


@dataclass(frozen=True, slots=True)
class WordBatch:
    """Sentences as tokens.

    Attributes:
        ids: (B, T) int64, padded with 0.
        word: Word of each token, (B, T) int64; tokens without a word have the number ``num_words``.
        num_words: Largest number of words of a sentence.
    """

    ids: Tensor
    word: Tensor
    num_words: int

    def to(self, device: torch.device) -> "WordBatch":
        """Returns the batch on a device."""
        return WordBatch(self.ids.to(device), self.word.to(device), self.num_words)


class WordTokens:
    """Splits words into the tokens of the encoder.

    Args:
        tokenizer: The encoder's tokenizer.
        most: Largest number of tokens of a sentence; words beyond it are dropped.
    """

    def __init__(self, tokenizer: Tokenizer, most: int = 256) -> None:
        self._tokenizer, self._most = tokenizer, most
        self._known: dict[str, list[int]] = {}
        special = ("[CLS]", "[SEP]", "[UNK]", "[MASK]")
        self._first, self._last, self._unknown, self._mask = (int(tokenizer.token_to_id(t) or 0) for t in special)

    @property
    def whole_words(self) -> list[str]:
        """The words that are one token."""
        return [token for token in self._tokenizer.get_vocab() if token.isalpha()]

    def of(self, word: str) -> list[int]:
        """Returns the tokens of a word, one at least and eight at most."""
        if word not in self._known:
            if len(self._known) > 200_000:
                self._known.clear()
            self._known[word] = self._tokenizer.encode(word[:40], add_special_tokens=False).ids[:8] or [self._unknown]
        return self._known[word]

    def batch(self, sentences: Sequence[Sequence[str]]) -> WordBatch:
        """Returns a padded batch."""
        rows: list[tuple[list[int], list[int]]] = []
        for words in sentences:
            found, owner = [self._first], [-1]
            for k, one in enumerate(words):
                pieces = self.of(one)
                if len(found) + len(pieces) >= self._most:
                    break
                found += pieces
                owner += [k] * len(pieces)
            rows.append(([*found, self._last], [*owner, -1]))
        length, num_words = max(len(tokens) for tokens, _ in rows), max(map(len, sentences))
        ids = torch.zeros(len(rows), length, dtype=torch.long)
        word = torch.full((len(rows), length), num_words, dtype=torch.long)
        for b, (tokens, owners) in enumerate(rows):
            ids[b, : len(tokens)] = torch.tensor(tokens)
            word[b, : len(owners)] = torch.tensor([k if k >= 0 else num_words for k in owners])
        return WordBatch(ids, word, num_words)

    def hide(self, batch: WordBatch, hidden: Tensor) -> WordBatch:
        """Returns the batch with the mask token in place of hidden tokens of words, (B, T) bool."""
        return replace(batch, ids=batch.ids.masked_fill(hidden & (batch.word < batch.num_words), self._mask))


@dataclass(frozen=True, slots=True)
class MentionScores:
    """Scores of the mentions of a batch, float32.

    Attributes:
        said: What is said of each, (B, M, classes) by name.
        start: Pairs at the start, (B, M, M, classes).
        goal: Pairs after the task, (B, M, M, classes).
    """

    said: Mapping[str, Tensor]
    start: Tensor
    goal: Tensor


class MentionAttention(nn.Module):
    """Layers in which mentions attend to each other and to the words. They change nothing before they are trained.

    Args:
        size: Width of the words.
        layers: Number of layers.
    """

    def __init__(self, size: int, layers: int = 2) -> None:
        super().__init__()
        self.memory = nn.Linear(size, _WIDTH)
        self.layers = nn.ModuleList(_silent_decoder_layer() for _ in range(layers))

    def forward(self, mentions: Tensor, words: Tensor, exists: Tensor, is_word: Tensor) -> Tensor:
        """Returns the mentions in context.

        Args:
            mentions: (B, M, 256).
            words: (B, W, D).
            exists: Whether a mention is one, not padding, (B, M) bool.
            is_word: Whether a word is one, not padding, (B, W) bool.
        """
        memory = self.memory(words)
        for layer in self.layers:
            mentions = layer(mentions, memory, tgt_key_padding_mask=~exists, memory_key_padding_mask=~is_word)
        return mentions


class MentionPairAttention(nn.Module):
    """A layer in which each pair of mentions attends to the pairs with the same first, then with the same second mention.

    So a thing that is on one carrier is on no other one, and chains are scored together. It changes nothing before it is trained.
    """

    def __init__(self) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(_PAIR) for _ in range(3))
        self.axes = nn.ModuleList(_silent_attention() for _ in range(2))
        self.feed = nn.Sequential(nn.Linear(_PAIR, 2 * _PAIR), nn.GELU(), nn.Dropout(0.1), _silent(nn.Linear(2 * _PAIR, _PAIR)))

    def forward(self, pairs: Tensor, exists: Tensor) -> Tensor:
        """Returns the pairs in context, (B, M, M, 192), from the pairs and whether each mention is one, (B, M) bool."""
        batch, size = exists.shape
        is_padding = (~exists)[:, None].expand(-1, size, -1).reshape(batch * size, size)
        for norm, axis in zip(self.norms, self.axes, strict=False):
            rows = norm(pairs).reshape(batch * size, size, -1)
            seen, _ = axis(rows, rows, rows, key_padding_mask=is_padding, need_weights=False)
            pairs = (pairs + seen.view_as(pairs)).transpose(1, 2)  # the other axis; twice is the first one again
        new: Tensor = self.feed(self.norms[2](pairs))
        return pairs + new


def _silent(layer: nn.Linear) -> nn.Linear:
    """A linear layer whose output is 0."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def _silent_attention() -> nn.MultiheadAttention:
    attention = nn.MultiheadAttention(_PAIR, 4, 0.1, batch_first=True)
    _silent(attention.out_proj)
    return attention


def _silent_decoder_layer() -> nn.TransformerDecoderLayer:
    layer = nn.TransformerDecoderLayer(_WIDTH, 4, 2 * _WIDTH, 0.1, "gelu", batch_first=True, norm_first=True)
    for part in (layer.self_attn.out_proj, layer.multihead_attn.out_proj, layer.linear2):
        _silent(part)
    return layer


class ReaderNetwork(nn.Module):
    """The network.

    Args:
        config: The encoder's configuration.
    """

    def __init__(self, config: BertConfig) -> None:
        from transformers import BertModel  # its import takes seconds, and jobs that read no instruction import this module

        super().__init__()
        self.encoder = BertModel(config, add_pooling_layer=False)
        size = config.hidden_size
        self.tags = nn.Linear(size, 3)
        self.mention = nn.Sequential(nn.Linear(3 * size, _WIDTH), nn.GELU(), nn.Dropout(0.1))
        layer = nn.TransformerEncoderLayer(_WIDTH, 4, 2 * _WIDTH, 0.1, "gelu", batch_first=True, norm_first=True)
        self.among = nn.TransformerEncoder(layer, 1, enable_nested_tensor=False)
        self.said = nn.ModuleDict({name: nn.Linear(2 * _WIDTH, count) for name, count in SAID.items()})
        self.one, self.other = nn.Linear(2 * _WIDTH, _PAIR), nn.Linear(2 * _WIDTH, _PAIR)
        self.between = nn.Linear(size, _PAIR)
        self.distance = nn.Embedding(2 * _MOST_BETWEEN + 3, _PAIR)
        self.pair = nn.Sequential(nn.GELU(), nn.Dropout(0.1), nn.Linear(_PAIR, _PAIR), nn.GELU())
        self.left, self.right = nn.Linear(2 * _WIDTH, 64), nn.Linear(2 * _WIDTH, 64)
        self.start_product = nn.Parameter(0.02 * torch.randn(len(START), 65, 65))
        self.goal_product = nn.Parameter(0.02 * torch.randn(len(GOAL), 65, 65))
        self.start, self.goal = nn.Linear(_PAIR, len(START)), nn.Linear(_PAIR, len(GOAL))
        self.in_sentence = MentionAttention(size)
        self.among_pairs = nn.ModuleList(MentionPairAttention() for _ in range(2))

    def words(self, batch: WordBatch) -> Tensor:
        """Returns a row for each word, the mean of its tokens, (B, W, D) float32; words beyond the tokens are 0."""
        hidden: Tensor = self.encoder(input_ids=batch.ids, attention_mask=(batch.ids != 0).long()).last_hidden_state.float()
        rows = hidden.new_zeros(len(hidden), batch.num_words + 1, hidden.shape[2])
        index = batch.word[..., None].expand_as(hidden)
        return rows.scatter_reduce(1, index, hidden, "mean", include_self=False)[:, : batch.num_words]

    def mention_scores(self, words: Tensor, spans: Tensor, exists: Tensor) -> MentionScores:
        """Scores mentions.

        Args:
            words: From :meth:`words`.
            spans: First and last word of each mention, (B, M, 2) int64; in the order of the text.
            exists: Whether a mention is one, not padding, (B, M) bool.
        """
        sums = pad(words.cumsum(1), (0, 0, 1, 0))  # (B, W + 1, D)

        def rows(index: Tensor, of: Tensor) -> Tensor:
            return of.gather(1, index[..., None].expand(-1, -1, of.shape[2]))

        first, last = spans.unbind(-1)
        mean = (rows(last + 1, sums) - rows(first, sums)) / (last + 1 - first)[..., None]
        own = self.mention(torch.cat([rows(first, words), rows(last, words), mean], -1))
        is_word = words.abs().sum(-1) > 0
        seen = self.in_sentence(self.among(own, src_key_padding_mask=~exists), words, exists, is_word)
        both = torch.cat([own, seen], -1)
        low = torch.minimum(last[:, :, None], last[:, None]) + 1
        high = torch.maximum(torch.maximum(first[:, :, None], first[:, None]), low)
        count = high - low
        gap = (rows(high.flatten(1), sums) - rows(low.flatten(1), sums)).view(*low.shape, -1)
        gap = gap / count.clamp(min=1)[..., None]
        sign = torch.sign(first[:, None] - first[:, :, None])
        far = sign * (count.clamp(max=_MOST_BETWEEN) + 1) + _MOST_BETWEEN + 1
        hidden = self.pair(self.one(both)[:, :, None] + self.other(both)[:, None] + self.between(gap) + self.distance(far))
        for layer in self.among_pairs:
            hidden = layer(hidden, exists)
        a, b = (pad(half(both), (0, 1), value=1.0) for half in (self.left, self.right))
        start = torch.einsum("bih,rhk,bjk->bijr", a, self.start_product, b) + self.start(hidden)
        goal = torch.einsum("bih,rhk,bjk->bijr", a, self.goal_product, b) + self.goal(hidden)
        return MentionScores({name: head(both) for name, head in self.said.items()}, start, goal)
