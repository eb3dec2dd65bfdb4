"""The training data of the reasoner: the rows of a run's ``samples`` and ``edits`` as tokens, and the tokenizer.

Rows are read by row groups, from a local folder or an object store. The tokens are cached in files, named by a hash of all that
they depend on. The split ``train`` is trained on, ``validation`` is evaluated; ``test`` and ``unseen`` are not read. Splits are
drawn by near-duplicate group, so that no validation scene is similar to a training scene.
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

_CACHE_VERSION = 1
_TOKENIZER_EXAMPLES = 30_000  # enough for the vocabulary


@dataclass(frozen=True, slots=True)
class ExampleSource:
    """The source of a training's examples.

    Attributes:
        uri: The run folder.
        cache: Local folder for the tokenizer and the tokens.
        settings: Settings of the training.
        every: Every how many row groups one is read: 1 reads all, a larger number is for an estimate.
    """

    uri: str
    cache: Path
    settings: ReasonerTrainingSettings
    every: int = 1

    def fingerprint(self) -> str:
        """Returns a fingerprint of the content of the tables.

        Raises:
            ConfigError: A table is missing.
        """
        folders = {"samples": self.uri} | ({} if self.edits is None else {"edits": self.edits})
        for table, folder in folders.items():
            RunFolder(folder).dataset(table)  # raises if it is missing
        return content_id({table: sorted(RunFolder(folder).shard_ids(table)) for table, folder in folders.items()})

    @property
    def edits(self) -> str | None:
        """The run folder whose table ``edits`` is read; None if none is."""
        folder_name = self.settings.edits
        if self.settings.shares.edit == 0:
            return None
        if not folder_name:
            return self.uri if RunFolder(self.uri).files("edits") else None
        is_the_table = (
            "://" not in folder_name and Path(folder_name).name == "edits" and not RunFolder(folder_name).files("edits")
        )
        return str(Path(folder_name).parent) if is_the_table else folder_name

    @property
    def _asks_whole(self) -> bool:
        return self.settings.shares.whole > 0

    def tokenizer(self) -> PreTrainedTokenizerBase:
        """Returns the tokenizer of ``tokenizer`` or ``base``; else one trained on the split ``train``, which is cached.

        Raises:
            ConfigError: It cannot be read or trained.
        """
        folder_name = self.settings.tokenizer or self.settings.base
        if folder_name:
            return read_tokenizer(Path(folder_name).expanduser())
        size = self.settings.network.vocabulary
        shaping = (self._asks_whole, self.settings.with_details, self.settings.seed, *_prompt_identity())
        folder = self.cache / f"tokenizer-{content_id(_CACHE_VERSION, self.fingerprint(), self.every, size, *shaping)}"
        if not (folder / "tokenizer.json").is_file():
            made = train_tokenizer(self._texts(), size)
            temporary = folder.with_name(f".{folder.name}")
            made.save_pretrained(temporary)
            temporary.replace(folder)
        return read_tokenizer(folder)

    def load(self, split: Split, tokenizer: PreTrainedTokenizerBase) -> TokenDataset:
        """Returns a split as memory-mapped tokens, from the cache if they are there.

        Raises:
            ConfigError: The table cannot be read, or the split ``train`` has no example (``set_empty``).
        """
        s = self.settings
        shaping = [s.max_tokens, s.with_details, s.required_share, self._asks_whole, *_prompt_identity()]
        if split == "train":
            shaping += [s.any_table_share, s.part_share, s.seed]
        key = content_id(_CACHE_VERSION, self.fingerprint(), self.every, fingerprint_of(tokenizer), split, shaping)
        folder = self.cache / f"{split}-{key}"
        found = read_tokens(folder)
        if found is None:
            found = write_tokens(folder, self.examples(split), tokenizer, s.max_tokens)
        if split == "train" and not len(found):
            raise ConfigError(
                f"{self.uri}: no example in the split train ({int(found.too_long.sum())} longer than {s.max_tokens} tokens), "
                "expected at least one; preprocess more scenes, or raise max_tokens",
                "set_empty",
            )
        return found

    def examples(self, split: Split) -> Iterator[TrainingExample]:
        """Returns the examples of a split in the order of the tables' files, edits last."""
        rows: Iterable[Row] = self._rows(self.uri, "samples", split)
        if split == "train" and self.settings.part_share:
            rows = map(self._maybe_cropped, rows)
        examples: Iterable[TrainingExample] = (example_of(row, self.settings.with_details, self._draws(row)) for row in rows)
        if self._asks_whole:
            examples = add_whole_layouts(examples)
        if self.edits is not None:
            examples = chain(examples, (edit_example_of(row) for row in self._rows(self.edits, "edits", split)))
        if split != "train":  # no augmentation
            return iter(examples)
        return (e.on_any_table() if self._hides_table_type(e) else e for e in examples)

    def _rows(self, uri: str, name: str, split: Split) -> Iterator[Row]:
        table = TableFiles(uri, name, None, split)
        for group in tqdm(range(0, len(table.groups), self.every), desc=f"{split} {name}", unit="group", leave=False):
            for part in row_slices(table.read([group])):
                yield from rows_from_table(part)

    def num_examples(self, split: Split) -> Counter[str]:
        """Counts the examples of each kind in a split, with those that are too long; ``every`` has no effect."""
        table = TableFiles(self.uri, "samples", ["stage"], split)
        found: Counter[str] = Counter()
        for group in range(len(table.groups)):
            found.update(table.read([group])["stage"].to_pylist())
        if self._asks_whole:
            found["whole"] = found[Stage.SECONDARY]
        if self.edits is not None:
            found["edit"] = len(TableFiles(self.edits, "edits", ["edit_id"], split))
        return found

    def _hides_table_type(self, example: TrainingExample) -> bool:
        # Drawn from a hash of the example, so that the order of the table has no effect.
        digest = content_id(self.settings.seed, example.scene_id, str(example.question.wanted), example.question.instruction)
        return int(digest, 16) / 16.0 ** len(digest) < self.settings.any_table_share

    def _draws(self, row: Row) -> np.random.Generator | None:
        """Draws what the question of a row states as required; None for a question that states nothing."""
        if not self.settings.required_share:
            return None
        digest = content_id(self.settings.seed, "required", row["scene_id"], (row["task"] or {}).get("task", ""))
        rng = np.random.default_rng(int(digest, 16))
        return rng if rng.random() < self.settings.required_share else None

    def _maybe_cropped(self, row: Row) -> Row:
        """The row, or a part of its table, which has no table type; all stages of a scene have the same part."""
        digest = content_id(self.settings.seed, "part", row["scene_id"], (row["task"] or {}).get("task", ""))
        rng = np.random.default_rng(int(digest, 16))
        part = crop_table(row, rng) if rng.random() < self.settings.part_share else None
        return row if part is None else {**part, "table_type": ANY_TABLE}

    def _texts(self) -> Iterator[str]:
        """Questions and answers of about :data:`_TOKENIZER_EXAMPLES` examples."""
        total = self.num_examples("train").total() / self.every
        if not total:
            raise ConfigError(f"{self.uri}: no row of samples in the split train; preprocess more scenes", "set_empty")
        rng = np.random.default_rng(self.settings.seed)
        # Each example is drawn by itself, so that no list of examples is in memory.
        for example in self.examples("train"):
            if rng.random() * total < _TOKENIZER_EXAMPLES:
                try:
                    yield example.prompt[-1]["content"]
                except SceneError:
                    continue  # an invalid instruction, which write_tokens counts
                yield example.answer


def fingerprint_of(tokenizer: PreTrainedTokenizerBase) -> str:
    """Returns a fingerprint of a tokenizer: of its vocabulary, chat template and end token."""
    text = tokenizer.backend_tokenizer.to_str() + str(tokenizer.chat_template) + str(tokenizer.eos_token)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _prompt_identity() -> tuple[int, tuple[str, ...]]:
    return PROMPT_VERSION, FIXED
