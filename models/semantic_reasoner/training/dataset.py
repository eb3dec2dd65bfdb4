"""What a run has for the reasoner: the rows of ``samples`` and ``edits`` as tokens, and the tokenizer that makes them.

Rows are read row group by row group, from a local folder or an object store; what was made of them is kept in files named by
all that shapes it. The split ``train`` is learned from and ``validation`` watched; ``test`` and ``unseen`` are not opened.
Splits are drawn by near-duplicate group, so that what is watched resembles nothing that is learned.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from tqdm import tqdm
from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.text.prompt import ANY_TABLE, FIXED, PROMPT_VERSION
from models.semantic_reasoner.text.tokenizer import train_tokenizer
from models.semantic_reasoner.training.examples import TrainingExample, add_whole_layouts, edit_example_of, example_of
from models.semantic_reasoner.training.hf_folder import read_tokenizer
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.table_crop import crop_table
from models.semantic_reasoner.training.token_dataset import TokenDataset, read_tokens, write_tokens
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, SceneError
from stable_data.scene import Stage
from stable_data.storage.row_groups import TableFiles, row_slices, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row

Split: TypeAlias = Literal["train", "validation"]

_VERSION = 1  # of the kept files
_TOKENIZER_EXAMPLES = 30_000  # enough for its words


@dataclass(frozen=True, slots=True)
class ExampleSource:
    """Where a training's examples come from.

    Attributes:
        uri: The run folder.
        cache: Local folder for what is made of it.
        settings: Of the training.
        every: Which row groups are read: 1 all, more for an estimate.
    """

    uri: str
    cache: Path
    settings: ReasonerTrainingSettings
    every: int = 1

    def fingerprint(self) -> str:
        """Content of the tables that are read.

        Raises:
            ConfigError: One is not there.
        """
        folders = {"samples": self.uri} | ({} if self.edits is None else {"edits": self.edits})
        for table, folder in folders.items():
            RunFolder(folder).dataset(table)  # says what is missing
        return content_id({table: sorted(RunFolder(folder).shard_ids(table)) for table, folder in folders.items()})

    @property
    def edits(self) -> str | None:
        """The run folder whose table ``edits`` is read; None where none is."""
        named = self.settings.edits
        if self.settings.shares.edit == 0:
            return None
        if not named:
            return self.uri if RunFolder(self.uri).files("edits") else None
        is_the_table = "://" not in named and Path(named).name == "edits" and not RunFolder(named).files("edits")
        return str(Path(named).parent) if is_the_table else named

    @property
    def _asks_whole(self) -> bool:
        return self.settings.shares.whole > 0

    def tokenizer(self) -> PreTrainedTokenizerBase:
        """The tokenizer: that of ``tokenizer`` or ``base``; else one made for the words of the split ``train``, and kept.

        Raises:
            ConfigError: There is none to read, or none can be made.
        """
        named = self.settings.tokenizer or self.settings.base
        if named:
            return read_tokenizer(Path(named).expanduser())
        size = self.settings.network.vocabulary
        shaping = (self._asks_whole, self.settings.with_details, self.settings.seed, *_prompt_parts())
        folder = self.cache / f"tokenizer-{content_id(_VERSION, self.fingerprint(), self.every, size, *shaping)}"
        if not (folder / "tokenizer.json").is_file():
            made = train_tokenizer(self._texts(), size)
            aside = folder.with_name(f".{folder.name}")
            made.save_pretrained(aside)
            aside.replace(folder)
        return read_tokenizer(folder)

    def load(self, split: Split, tokenizer: PreTrainedTokenizerBase) -> TokenDataset:
        """A split as tokens: mapped where it was kept, else made and kept.

        Raises:
            ConfigError: The table cannot be read, or there is nothing to learn from.
        """
        s = self.settings
        shaping = [s.max_tokens, s.with_details, self._asks_whole, *_prompt_parts()]
        if split == "train":
            shaping += [s.any_table_share, s.part_share, s.seed]
        key = content_id(_VERSION, self.fingerprint(), self.every, fingerprint_of(tokenizer), split, shaping)
        folder = self.cache / f"{split}-{key}"
        found = read_tokens(folder)
        if found is None:
            found = write_tokens(folder, self.examples(split), tokenizer, s.max_tokens)
        if split == "train" and not len(found):
            raise ConfigError(
                f"{self.uri}: no example in the split train ({int(found.too_long.sum())} longer than {s.max_tokens} tokens), "
                "expected one at least; preprocess more scenes, or raise max_tokens",
                "set_empty",
            )
        return found

    def examples(self, split: Split) -> Iterator[TrainingExample]:
        """The examples of a split in the order of the tables' files, edits last."""
        rows: Iterable[Row] = self._rows(self.uri, "samples", split)
        if split == "train" and self.settings.part_share:
            rows = map(self._perhaps_a_part, rows)
        examples: Iterable[TrainingExample] = (example_of(row, self.settings.with_details) for row in rows)
        if self._asks_whole:
            examples = add_whole_layouts(examples)
        if self.edits is not None:
            examples = chain(examples, (edit_example_of(row) for row in self._rows(self.edits, "edits", split)))
        if split != "train":  # every question is asked as it stands
            return iter(examples)
        return (e.on_any_table() if self._is_on_any_table(e) else e for e in examples)

    def _rows(self, uri: str, name: str, split: Split) -> Iterator[Row]:
        table = TableFiles(uri, name, None, split)
        for group in tqdm(range(0, len(table.groups), self.every), desc=f"{split} {name}", unit="group", leave=False):
            for part in row_slices(table.read([group])):
                yield from rows_from_table(part)

    def num_examples(self, split: Split) -> Counter[str]:
        """How many examples of each kind a split has, those that are too long included, whatever ``every`` is."""
        table = TableFiles(self.uri, "samples", ["stage"], split)
        found: Counter[str] = Counter()
        for group in range(len(table.groups)):
            found.update(table.read([group])["stage"].to_pylist())
        if self._asks_whole:
            found["whole"] = found[Stage.SECONDARY]
        if self.edits is not None:
            found["edit"] = len(TableFiles(self.edits, "edits", ["edit_id"], split))
        return found

    def _is_on_any_table(self, example: TrainingExample) -> bool:
        # Named by the example, so that it does not matter where in the table it lies.
        lot = content_id(self.settings.seed, example.scene_id, str(example.ask.wanted), example.ask.instruction)
        return int(lot, 16) / 16.0 ** len(lot) < self.settings.any_table_share

    def _perhaps_a_part(self, row: Row) -> Row:
        """The row, or a part of its table, which is no table of its kind; the same part in all stages."""
        lot = content_id(self.settings.seed, "part", row["scene_id"], (row["task"] or {}).get("task", ""))
        rng = np.random.default_rng(int(lot, 16))
        part = crop_table(row, rng) if rng.random() < self.settings.part_share else None
        return row if part is None else {**part, "table_type": ANY_TABLE}

    def _texts(self) -> Iterator[str]:
        """Questions and answers of about so many examples as a tokenizer needs."""
        total = self.num_examples("train").total() / self.every
        if not total:
            raise ConfigError(f"{self.uri}: no row of samples in the split train; preprocess more scenes", "set_empty")
        rng = np.random.default_rng(self.settings.seed)
        for example in self.examples("train"):
            if rng.random() * total < _TOKENIZER_EXAMPLES:
                try:
                    yield example.prompt[-1]["content"]
                except SceneError:
                    continue  # it is counted where it is left out
                yield example.answer


def fingerprint_of(tokenizer: PreTrainedTokenizerBase) -> str:
    """Content of a tokenizer: its words, and the template of its chats."""
    text = tokenizer.backend_tokenizer.to_str() + str(tokenizer.chat_template) + str(tokenizer.eos_token)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _prompt_parts() -> tuple[int, tuple[str, ...]]:
    return PROMPT_VERSION, FIXED
