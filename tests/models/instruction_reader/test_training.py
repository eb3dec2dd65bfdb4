"""Training of the reader: exact resume, weights on disk, and the job."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from models.instruction_reader.averaging import average_readers
from models.instruction_reader.frames import Frame, read_frames
from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.network import START, ReaderNetwork, WordTokens
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reader import InstructionReader
from models.instruction_reader.sentences import split_words
from models.instruction_reader.spelling import Spelling
from models.instruction_reader.training import ReaderTrainer, ReaderTrainingSettings, split_frames, targets_of
from models.instruction_reader.weights import ReaderModel, load_reader, new_reader, save_reader
from pipelines.__main__ import app
from stable_data.errors import ConfigError

NOUNS = read_nouns()
SHORT = ReaderTrainingSettings(sentences=32, batch=4)


@cache
def frames() -> tuple[Frame, ...]:
    return tuple(read_frames())


@pytest.fixture
def model() -> ReaderModel:
    return new_reader()


def trainer(model: ReaderModel, settings: ReaderTrainingSettings = SHORT, identity: str = "one") -> ReaderTrainer:
    return ReaderTrainer(model.network, model.tokens, frames(), NOUNS, settings, {"frames": identity})


def values(network: ReaderNetwork) -> list[torch.Tensor]:
    return [value.clone() for value in network.state_dict().values()]


@pytest.mark.slow
def test_a_stopped_training_ends_as_one_that_was_not_stopped(tmp_path: Path, model: ReaderModel) -> None:
    whole = trainer(model)
    losses = [whole.train_step()["start"] for _ in range(4)]
    first = trainer(new_reader())
    assert [first.train_step()["start"] for _ in range(2)] == losses[:2]
    first.save(tmp_path / "state.pt")
    second = trainer(new_reader(1))
    second.resume(tmp_path / "state.pt")
    assert second.step == 2
    assert [second.train_step()["start"] for _ in range(2)] == losses[2:]
    assert all(map(torch.equal, values(second.network), values(whole.network)))
    with pytest.raises(ConfigError, match="frames"):
        trainer(new_reader(), identity="other").resume(tmp_path / "state.pt")
    with pytest.raises(ConfigError, match="seed"):
        trainer(new_reader(), replace(SHORT, seed=1)).resume(tmp_path / "state.pt")


def test_embeddings_stay_and_layers_learn(model: ReaderModel) -> None:
    was = {name: value.clone() for name, value in model.network.named_parameters()}
    trainer(model).train_step()
    changed = {name for name, value in model.network.named_parameters() if not torch.equal(value, was[name])}
    assert not any("embeddings" in name for name in changed)
    assert {"tags.weight", "start.weight", "encoder.encoder.layer.0.attention.self.query.weight"} <= changed


def test_held_out_frames_are_in_no_training() -> None:
    train, held = split_frames(frames())
    assert len(train) + len(held) == len(frames())
    assert not {f.text for f in train} & {f.text for f in held}
    assert 0.03 < len(held) / len(frames()) < 0.05
    assert {f.is_edit for f in held} == {False, True}


def test_labels_are_classes_of_the_heads(model: ReaderModel) -> None:
    batch = trainer(model).held_out(32)
    found = targets_of(batch, max(len(s.words) for s in batch))
    for b, sentence in enumerate(batch):
        assert int((found.tags[b] == 1).sum()) == len(sentence.mentions)
        assert int((found.tags[b] == -100).sum()) == found.tags.shape[1] - len(sentence.words)
        same = int((found.start[b] == START.index("same")).sum())
        objects = [k for _, _, k in sentence.mentions]
        assert same == sum(a == c for i, a in enumerate(objects) for j, c in enumerate(objects) if i != j)


def test_scores_do_not_depend_on_the_other_sentences(model: ReaderModel) -> None:
    network = model.network.eval()
    one, other = (
        split_words(text) for text in ("the mug on the tray", "please take the pencil out of the wooden cup over there")
    )
    with torch.no_grad():
        alone, together = network.words(model.tokens.batch([one])), network.words(model.tokens.batch([one, other]))
        assert together[0, : len(one)] == pytest.approx(alone[0], abs=1e-5)
        spans, padded = torch.tensor([[[1, 1], [4, 4]]]), torch.tensor([[[1, 1], [4, 4], [0, 0]], [[3, 3], [8, 8], [10, 10]]])
        exists = torch.tensor([[True, True, False], [True, True, True]])
        a = network.mention_scores(alone, spans, exists[:1, :2])
        b = network.mention_scores(together, padded, exists)
    assert b.start[0, :2, :2] == pytest.approx(a.start[0], abs=1e-4)
    assert b.said["count"][0, :2] == pytest.approx(a.said["count"][0], abs=1e-4)


def test_words_beyond_the_longest_sentence_have_no_meaning(model: ReaderModel) -> None:
    tokens = WordTokens(model.tokens._tokenizer, most=8)
    batch = tokens.batch([["mug"] * 50])
    assert batch.ids.shape[1] <= 8
    assert not model.network.words(batch)[0, 20:].any()


def test_weights_come_back_from_disk(tmp_path: Path, model: ReaderModel) -> None:
    with torch.no_grad():
        for name, value in model.network.named_parameters():  # what a training changes
            if "embeddings" not in name:
                value.add_(torch.randn_like(value), alpha=1e-3)
    path = tmp_path / "reader.safetensors"
    save_reader(path, model, {"steps": "3"})
    assert path.stat().st_size < 20e6
    found = load_reader(path)
    assert found.notes["steps"] == "3"
    for (name, was), now in zip(model.network.state_dict().items(), found.network.state_dict().values(), strict=True):
        assert float((now - was).abs().max()) <= 2e-3 * float(was.abs().max()) + 1e-6, name


def test_files_that_are_no_reader_are_refused(tmp_path: Path, model: ReaderModel) -> None:
    with pytest.raises(ConfigError, match="cannot be read as safetensors"):
        load_reader(tmp_path / "nothing")
    (tmp_path / "text").write_text("no weights", "utf-8")
    with pytest.raises(ConfigError, match="cannot be read as safetensors"):
        load_reader(tmp_path / "text")
    save_reader(tmp_path / "other", replace(model, encoder="0123"), {})
    with pytest.raises(ConfigError, match="sentence encoder 0123"):
        load_reader(tmp_path / "other")


@pytest.mark.parametrize(
    "text", ["", "   ", "🤖🤖", "…", "mug " * 10_000, "Bitte stell die Tasse weg", "<|im_end|>{}[]:", "\ue000a\uf000"]
)
def test_any_text_can_be_read(model: ReaderModel, text: str) -> None:
    lexicon = Lexicon.of(NOUNS, NOUNS.nouns)
    spelling = Spelling.of([frame.text for frame in frames()[:10]], NOUNS, model.tokens.whole_words)
    reader = InstructionReader(model, lexicon, spelling)
    for is_edit in (False, True):
        reading = reader.read(text, is_edit)
        assert all(0 <= r.subject < len(reading.objects) > r.target for r in (*reading.start, *reading.goal))


@pytest.mark.slow
def test_the_job_trains_stops_and_continues(tmp_path: Path) -> None:
    frames, out = tmp_path / "frames", tmp_path / "out"
    frames.mkdir()
    (frames / "few.txt").write_text("take the {a} <r> the {b} => a r b; > take a\n", "utf-8")
    command = ["train-reader", "--frames", str(frames), "--out", str(out), "--set", "sentences=16", "--set", "batch=4"]
    runner = CliRunner()
    done = runner.invoke(app, [*command, "--minutes", "0.0001"])
    assert done.exit_code == 0, done.output
    assert "run again to continue" in done.output
    done = runner.invoke(app, command)
    assert done.exit_code == 0, done.output
    assert "4 of 4 steps" in done.output
    assert load_reader(out / "weights" / "instruction_reader.safetensors").notes["steps"] == "4"
    refused = runner.invoke(app, [*command, "--set", "seed=1"])
    assert refused.exit_code == 2
    (frames / "few.txt").write_text("take the {a}\n", "utf-8")
    broken = runner.invoke(app, [*command[:4], str(tmp_path / "new")])
    assert broken.exit_code == 2
    assert "it has no =>" in broken.output


def test_hidden_tokens_are_of_words_alone(model: ReaderModel) -> None:
    batch = model.tokens.batch([["the", "red", "mug"], ["mug"]])
    hidden = model.tokens.hide(batch, torch.ones_like(batch.ids, dtype=torch.bool))
    is_word = batch.word < batch.num_words
    assert torch.equal(hidden.ids[~is_word], batch.ids[~is_word])
    assert len(set(hidden.ids[is_word].tolist())) == 1
    assert torch.equal(hidden.word, batch.word)


@pytest.mark.slow
def test_a_training_continues_from_weights_that_are_there(tmp_path: Path, model: ReaderModel) -> None:
    path = tmp_path / "first.safetensors"
    save_reader(path, model, {"steps": "0", "frames": "none"})
    again = load_reader(path, trains=True)
    assert again.network.training
    assert any(p.requires_grad for p in again.network.parameters())
    job = ["train-reader", "--set", "sentences=8", "--set", "batch=4", "--set", "masked_sentences=0.5", "--set", "dropout=0.1"]
    done = CliRunner().invoke(app, [*job, "--out", str(tmp_path / "second"), "--set", f"initial={path}"])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "second" / "weights" / "instruction_reader.safetensors").is_file()


def test_the_mean_of_equal_readers_is_the_reader_and_of_two_lies_between() -> None:
    one, same, other = new_reader(0), new_reader(0), new_reader(1)
    was = one.network.tags.weight.detach().clone()
    assert torch.allclose(average_readers([one, same], [3.0, 1.0]).network.tags.weight, was)
    middle = average_readers([one, other], [1.0, 1.0]).network.tags.weight
    assert torch.allclose(middle, (was + other.network.tags.weight) / 2)


def test_favoured_frames_are_drawn_more_often(model: ReaderModel) -> None:
    def drawn(favoured: str) -> int:
        own = [frame for frame in frames() if frame.source in ("plain", "short_notes")]
        settings = replace(SHORT, favoured=favoured, favour=50)
        maker = ReaderTrainer(model.network, model.tokens, own, NOUNS, settings, {})
        return sum(len(s.words) < 12 for batch in maker._batches(0) for s in batch)

    assert drawn("short_notes") > drawn("plain")
    with pytest.raises(ConfigError, match="'nothing'") as caught:
        drawn("nothing")
    assert caught.value.code == "frames_unknown"
