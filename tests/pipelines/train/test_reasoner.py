import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from transformers import AutoModelForCausalLM, AutoTokenizer
from typer.testing import CliRunner

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.text.prompt import PROMPT_VERSION
from models.semantic_reasoner.training.batch_sampler import batches_of_pass
from models.semantic_reasoner.training.dataset import ExampleSource
from models.semantic_reasoner.training.hf_folder import write_model
from models.semantic_reasoner.training.network import new_network
from models.semantic_reasoner.training.settings import LoraSettings, ReasonerTrainingSettings, StageShares
from models.semantic_reasoner.training.token_dataset import KINDS
from models.training.distributed import ProcessContext
from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from pipelines.settings import SECTIONS
from pipelines.train.estimate import training_plan
from pipelines.train.ray_train import run_on_ray
from pipelines.train.reasoner import CHECKPOINT, ReasonerMonitoring, ReasonerTrainingJob
from stable_data.embedded_world.edit_table import write_edits
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder
from tests.models.semantic_reasoner.training.reasoner_examples import TINY, tokenizer
from tests.pipelines.runs import ROOT, SMALL

SETTINGS = replace(TINY, steps=6, tokens_per_batch=1500, max_tokens=2000, accumulate=2, any_table_share=0.5)
ONE_SHOT = StageShares(task=0.0, important=0.0, secondary=0.0, whole=1.0)
WATCH = ReasonerMonitoring(log_every=2, validate_every=4, validate_examples=2)


@pytest.fixture(scope="module")
def run(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The samples of four scenes, two tasks each, some in the split validation; without meshes, so that it is quickly done."""
    root, out = (tmp_path_factory.mktemp("samples") / name for name in ("data", "run"))
    shutil.copytree(dataset, root, ignore=shutil.ignore_patterns("Assets_library"))
    preprocess(str(root), str(out), replace(SMALL, train_share=0.6, validation_share=0.4, tasks_per_scene=2), WorkerPool())
    return out


@pytest.fixture(scope="module")
def cache(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a training makes of the run first."""
    root = tmp_path_factory.mktemp("cache")
    source = ExampleSource(str(run), root / "cache", SETTINGS)
    for split in ("train", "validation"):
        source.load(split, source.tokenizer())
    return root


@pytest.fixture
def out(cache: Path, tmp_path: Path) -> Path:
    """A folder in which that is done."""
    return Path(shutil.copytree(cache, tmp_path / "out"))


@pytest.fixture(scope="module")
def base(cache: Path, run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model of random weights."""
    folder = tmp_path_factory.mktemp("base") / "qwen"
    words = ExampleSource(str(run), cache / "cache", SETTINGS).tokenizer()
    write_model(folder, new_network(TINY.network, words, 2000, seed=5), words, {})
    return folder


def job(
    run: Path, out: Path, settings: ReasonerTrainingSettings = SETTINGS, minutes: float = 0.0, watch: ReasonerMonitoring = WATCH
) -> ReasonerTrainingJob:
    return ReasonerTrainingJob(str(run), out, settings, watch, minutes)


def weights(out: Path) -> dict[str, torch.Tensor]:
    found: dict[str, torch.Tensor] = AutoModelForCausalLM.from_pretrained(out / "weights").state_dict()
    return found


def checkpoint_values(out: Path) -> dict[str, Any]:
    """The plain values of a training's checkpoint."""
    (folder,) = (out / CHECKPOINT).iterdir()
    found: dict[str, Any] = json.loads((folder / "training.json").read_text("utf-8"))["values"]
    return found


def num_saved_weights(out: Path) -> int:
    """The number of the trained weights in a training's checkpoint."""
    tensors = [found for file in (out / CHECKPOINT).glob("*/*.safetensors") for found in load_file(file).items()]
    return sum(value.numel() for name, value in tensors if name.startswith("weights."))


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["train-reasoner", *map(str, arguments)])


def test_a_training_leaves_weights_logs_and_manifest(run: Path, out: Path) -> None:
    line = job(run, out).run()
    assert "6 of 6 steps" in line
    assert "nats a token important" in line
    notes = json.loads((out / "weights" / "reasoner.json").read_text("utf-8"))
    assert (notes["steps"], notes["is_done"], notes["prompt_version"]) == (6, True, PROMPT_VERSION)
    assert notes["data"] == ExampleSource(str(run), out, SETTINGS).fingerprint()
    assert notes["tokens"] > 0
    assert notes["settings"]["network"]["hidden"] == TINY.network.hidden
    assert set(notes["figures"]) == {f"validation/{kind}" for kind in ("task", "important", "secondary")}
    manifest = json.loads((out / "manifest.json").read_text("utf-8"))
    assert (manifest["status"], manifest["steps_done"]) == ("complete", 6)
    counts = manifest["examples"]
    rows = RunFolder(str(run)).table("samples", ["split"])["split"].to_pylist()
    for split in ("train", "validation"):
        assert counts[split]["used"] + counts[split]["left_out_too_long"] == rows.count(split) > 0
    log = EventAccumulator(str(out / "logs"))
    log.Reload()
    assert [event.step for event in log.Scalars("loss/train")] == [2, 4, 6]
    assert [event.step for event in log.Scalars("validation/task")] == [4, 6]


def test_the_checks_know_the_run_s_categories(run: Path, out: Path) -> None:
    job(run, out).run()
    found = CategoryStatistics.load(out / "weights")
    assert found == CategoryStatistics.of_run(str(run))
    assert found.categories
    assert found.tables


@pytest.mark.slow
def test_the_weights_are_a_plain_folder(run: Path, out: Path, tmp_path: Path) -> None:
    job(run, out).run()
    code = (
        "import sys; from transformers import AutoModelForCausalLM, AutoTokenizer\n"
        "t = AutoTokenizer.from_pretrained(sys.argv[1]); m = AutoModelForCausalLM.from_pretrained(sys.argv[1])\n"
        "asked = t.apply_chat_template([{'role': 'user', 'content': 'Move the mug'}], add_generation_prompt=True,"
        " return_tensors='pt')\n"
        "print(m.generate(**asked, max_new_tokens=3, do_sample=False).shape[1] - asked['input_ids'].shape[1])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code, str(out / "weights")], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert int(found.stdout) in (1, 2, 3)


def test_stopped_and_run_again_it_gives_the_weights_of_one_run(run: Path, out: Path, tmp_path: Path, cache: Path) -> None:
    other = Path(shutil.copytree(cache, tmp_path / "other"))
    job(run, other).run()
    stopped = job(run, out, minutes=1e-9).run()
    assert "1 of 6 steps" in stopped
    assert "run again to continue" in stopped
    assert json.loads((out / "manifest.json").read_text("utf-8"))["status"] == "stopped"
    assert "6 of 6 steps" in job(run, out).run()
    file = "weights/model.safetensors"
    assert (out / file).read_bytes() == (other / file).read_bytes()
    job(run, out).run()  # done already
    assert (out / file).read_bytes() == (other / file).read_bytes()
    assert sorted(path.name for path in out.iterdir()) == [".lock", "cache", "checkpoint", "logs", "manifest.json", "weights"]


def command_of(run: Path, out: Path, steps: int) -> Sequence[str]:
    tiny = {
        **{f"network.{key}": value for key, value in (("hidden", 32), ("layers", 2), ("head", 8), ("intermediate", 64))},
        "network.vocabulary": 300,
        "tokens_per_batch": 1500,
        "steps": steps,
    }
    sets = [f"--set={key}={value}" for key, value in tiny.items()]
    return [sys.executable, "-m", "pipelines", "train-reasoner", "--data", str(run), "--out", str(out), *sets]


@pytest.mark.slow
def test_killed_and_terminated_and_run_again_it_gives_the_weights_of_one_run(run: Path, tmp_path: Path) -> None:
    steps, environment = 120, os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(command_of(run, tmp_path / "one", steps), check=True, capture_output=True, env=environment)
    out = tmp_path / "out"
    for number in (signal.SIGTERM, signal.SIGKILL):
        process = subprocess.Popen(command_of(run, out, steps), stderr=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        assert process.stderr is not None
        seen = b""
        while b"step/s]" not in seen:
            seen = (seen + os.read(process.stderr.fileno(), 4096))[-10_000:]
        time.sleep(1.0)
        process.send_signal(number)
        process.communicate()
        if number == signal.SIGTERM:
            assert process.returncode == 0
            assert 0 < checkpoint_values(out)["step"] < steps
    subprocess.run(command_of(run, out, steps), check=True, capture_output=True, env=environment)
    assert (out / "weights/model.safetensors").read_bytes() == (tmp_path / "one/weights/model.safetensors").read_bytes()


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray.*")  # of Ray about itself
@pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing.:FutureWarning")  # of peft about transformers
@pytest.mark.parametrize("way", ["new", "muon", "packed", "base", "lora", "recomputes"])
def test_two_processes_with_sharded_weights_give_what_one_gives(
    run: Path, out: Path, base: Path, tmp_path: Path, cache: Path, way: str
) -> None:
    settings = {
        "new": SETTINGS,
        "muon": replace(SETTINGS, optimizer="muon"),
        "packed": replace(SETTINGS, packs=True),
        "base": replace(SETTINGS, base=str(base)),
        "lora": replace(SETTINGS, base=str(base), lora=LoraSettings(4, 8)),
        "recomputes": replace(SETTINGS, base=str(base), recomputes=True, precision="bfloat16"),
    }[way]
    other = Path(shutil.copytree(cache, tmp_path / "other"))
    job(run, other, settings).run()
    job(run, out, settings).run(2)
    losses, norms = [], []
    for folder in (out, other):
        log = EventAccumulator(str(folder / "logs"))
        log.Reload()
        losses.append([event.value for name in ("loss/train", "validation/task") for event in log.Scalars(name)])
        norms.append([event.value for event in log.Scalars("gradient_norm")])
    # Muon gives small singular values of a gradient the size of the large ones, and so the rounding of its sum over processes
    # too.
    amplifies = settings.optimizer == "muon"
    tolerance = 1e-2 if settings.precision == "bfloat16" else 1e-4
    assert losses[0] == pytest.approx(losses[1], rel=tolerance)
    assert norms[0][0] == pytest.approx(norms[1][0], rel=tolerance)
    assert norms[0] == pytest.approx(norms[1], rel=5e-3 if amplifies else tolerance)
    here, there = weights(other), weights(out)
    assert set(here) == set(there)
    if settings.precision == "float32":
        assert all(here[name].allclose(value, atol=5e-3 if amplifies else 2e-3) for name, value in there.items())


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray.*")  # of Ray about itself
def test_one_process_goes_on_where_two_stopped(run: Path, out: Path, tmp_path: Path, cache: Path) -> None:
    other = Path(shutil.copytree(cache, tmp_path / "other"))
    job(run, other).run()
    assert "1 of 6 steps" in job(run, out, minutes=1e-9).run(2)
    assert "6 of 6 steps" in job(run, out).run()
    here, there = weights(other), weights(out)
    assert all(here[name].allclose(value, atol=2e-3) for name, value in there.items())


def kill_a_worker(out: Path, killed: list[int]) -> None:
    """Kills a process of Ray Train as soon as there is a checkpoint, as a system without memory would."""
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline:
        if list((out / CHECKPOINT).glob("[0-9]*")):
            names = {int(path.parent.name): path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline")}
            if found := [number for number, name in names.items() if name.startswith(b"ray::") and b"RayTrainWorker" in name]:
                killed.append(found[-1])
                os.kill(found[-1], signal.SIGKILL)
                return
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray.*")  # of Ray about itself
def test_after_the_loss_of_a_process_the_run_ends_with_the_weights_of_one_without(
    run: Path, out: Path, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings, watch = replace(SETTINGS, steps=150), replace(WATCH, validate_every=1000, save_minutes=1e-9)
    other = Path(shutil.copytree(cache, tmp_path / "other"))
    job(run, other, settings, watch=watch).run(2)
    killed: list[int] = []
    thread = threading.Thread(target=kill_a_worker, args=(out, killed))
    thread.start()
    assert "150 of 150 steps" in job(run, out, settings, watch=watch).run(2)
    thread.join()
    assert len(killed) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if "was lost" in line]
    assert len(said) == 1
    assert "restart 1 of 3 from the last checkpoint" in said[0]
    file = "weights/model.safetensors"
    assert (out / file).read_bytes() == (other / file).read_bytes()


class FailingWork:
    """Fails in the second process until it was started often enough, in its own way."""

    def __init__(self, folder: Path, way: str, times: int) -> None:
        self._folder, self._way, self._times = folder, way, times

    def __call__(self, place: ProcessContext) -> None:
        """The part of one process."""
        before = len(list(self._folder.glob("start-*")))
        torch.distributed.barrier()
        if place.rank == 1:
            (self._folder / f"start-{before}").touch()
            if before < self._times and self._way == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            if before < self._times:
                raise ConfigError("this cannot be done", "config_invalid")
        torch.distributed.barrier()


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore::DeprecationWarning:ray.*")  # of Ray about itself
@pytest.mark.parametrize(("way", "code", "starts"), [("killed", "ray_failed", 4), ("raises", "config_invalid", 1)])
def test_a_process_that_always_fails_ends_the_run(
    way: str, code: str, starts: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError) as caught:
        run_on_ray(FailingWork(tmp_path, way, times=9), tmp_path, 2, None)
    assert caught.value.code == code
    assert "\n" not in str(caught.value)
    assert len(list(tmp_path.glob("start-*"))) == starts, caught.value
    assert capsys.readouterr().err.count("was lost") == starts - 1


def test_other_settings_and_data_are_refused_and_named(run: Path, out: Path, tmp_path: Path) -> None:
    job(run, out, minutes=1e-9).run()
    with pytest.raises(ConfigError, match=r"weight_decay: 0.05 -> 0.5"):
        job(run, out, replace(SETTINGS, weight_decay=0.5)).run()
    less = Path(shutil.copytree(run, tmp_path / "less"))
    next((less / "samples").glob("*.parquet")).unlink()
    with pytest.raises(ConfigError, match=r"data: \w+ -> \w+|no example|no row"):
        job(less, out).run()


def test_only_the_splits_that_may_be_seen_are_read(run: Path, tmp_path: Path) -> None:
    source = ExampleSource(str(run), tmp_path, replace(SETTINGS, any_table_share=0.0))
    table = RunFolder(str(run)).table("samples", ["scene_id", "split"]).to_pydict()
    split_of = dict(zip(table["scene_id"], table["split"], strict=True))
    for split in ("train", "validation"):
        found = {example.scene_id for example in source.examples(split)}
        assert found == {scene for scene, of in split_of.items() if of == split}
        assert source.num_examples(split).total() == len(list(source.examples(split)))


def test_the_kind_of_table_is_left_out_in_training_alone(run: Path, tmp_path: Path) -> None:
    source = ExampleSource(str(run), tmp_path, replace(SETTINGS, any_table_share=1.0))
    assert {e.question.table.table_type for e in source.examples("train")} == {"table"}
    assert "table" not in {e.question.table.table_type for e in source.examples("validation")}
    none = replace(source, settings=replace(SETTINGS, any_table_share=0.0))
    assert "table" not in {e.question.table.table_type for e in none.examples("train")}


def test_tokens_are_kept_by_all_that_shapes_them(run: Path, tmp_path: Path) -> None:
    ways = (
        SETTINGS,
        replace(SETTINGS, any_table_share=0.0),
        replace(SETTINGS, with_details=True),
        replace(SETTINGS, shares=ONE_SHOT),
    )
    words = ExampleSource(str(run), tmp_path, SETTINGS).tokenizer()
    found = [
        ExampleSource(str(run), tmp_path, way).load("train", words) for way in (*ways, replace(SETTINGS, learning_rate=1.0))
    ]
    assert len(list(tmp_path.glob("train-*"))) == len(ways)
    wholes = int((found[3].kind == KINDS.index("whole")).sum())
    assert 3 * wholes == len(found[3]) - wholes == len(found[0])
    assert found[2].start[-1] > found[0].start[-1]


@pytest.fixture(scope="module")
def drafted(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with edits of the run's scenes."""
    out = tmp_path_factory.mktemp("drafted")
    assert sum(count for count, _ in write_edits(RunFolder(str(run)), RunFolder(str(out)), count=3)) == 12
    return out


def test_edits_are_learned_from_where_they_are(run: Path, drafted: Path, tmp_path: Path) -> None:
    plain = ExampleSource(str(run), tmp_path / "cache", SETTINGS)
    both = Path(shutil.copytree(run, tmp_path / "both"))
    shutil.copytree(drafted / "edits", both / "edits")
    ways = [
        ExampleSource(str(both), tmp_path / "cache", SETTINGS),
        ExampleSource(str(run), tmp_path / "cache", replace(SETTINGS, edits=str(drafted))),
        ExampleSource(str(run), tmp_path / "cache", replace(SETTINGS, edits=str(drafted / "edits"))),
    ]
    rows = RunFolder(str(drafted)).table("edits").to_pylist()
    for split in ("train", "validation"):
        told = [row for row in rows if row["split"] == split]
        assert told
        for way in ways:
            found = list(way.examples(split))
            assert way.num_examples(split) == plain.num_examples(split) + Counter(edit=len(told))
            assert way.num_examples(split).total() == len(found)
            assert [e.question.instruction for e in found if e.question.edits] == [row["instruction"] for row in told]
            assert [list(e.removed or ()) != [] for e in found if e.question.edits] == [row["removed"] != [] for row in told]
    assert len({way.fingerprint() for way in ways}) == 1 != len({plain.fingerprint(), ways[0].fingerprint()})
    unread = replace(ways[0], settings=replace(SETTINGS, shares=replace(SETTINGS.shares, edit=0.0)))
    assert unread.fingerprint() == plain.fingerprint()
    assert not [e for e in unread.examples("train") if e.question.edits]


def test_edits_have_a_share_of_their_own_and_are_watched(run: Path, drafted: Path, tmp_path: Path) -> None:
    settings = replace(SETTINGS, steps=2, edits=str(drafted))
    assert "nats a token edit" in job(run, tmp_path / "out", settings).run()
    source = ExampleSource(str(run), tmp_path / "out" / "cache", settings)
    data = source.load("train", source.tokenizer())
    edits = set((data.kind == KINDS.index("edit")).nonzero()[0].tolist())
    assert len(edits) == source.num_examples("train")["edit"] - int(data.too_long[KINDS.index("edit")])
    half = replace(settings, shares=replace(settings.shares, edit=0.5))
    taken = {k for rows in batches_of_pass(data, half, 0) for row in rows for k in row}
    assert len(taken & edits) == round(0.5 * len(edits)) < len(edits)
    fewer = RunFolder(str(tmp_path / "fewer"))
    assert any(count for count, _ in write_edits(RunFolder(str(run)), fewer, count=1))
    with pytest.raises(ConfigError, match=r"data: \w+ -> \w+"):
        job(run, tmp_path / "out", replace(settings, edits=fewer.uri)).run()


def test_edits_that_are_named_but_not_there_are_one_line_and_status_2(run: Path, out: Path, tmp_path: Path) -> None:
    result = invoke("--data", run, "--out", out, "--set", f"edits={tmp_path}")
    assert result.exit_code == 2
    assert "no table edits" in result.stderr


def test_one_shot_is_a_training_of_its_own(run: Path, tmp_path: Path) -> None:
    said = job(run, tmp_path / "out", replace(SETTINGS, steps=1, shares=ONE_SHOT)).run()
    assert "whole" in said.partition("nats a token")[2]


def test_a_judge_adds_its_figures(run: Path, out: Path) -> None:
    seen: list[int] = []

    def judge(model: Any, words: Any) -> dict[str, float]:
        seen.append(model.num_parameters())
        return {"generation/kept": 0.5}

    job(run, out, watch=replace(WATCH, judge=judge)).run()
    assert len(seen) == 2  # once on the way, once in the end
    assert json.loads((out / "weights" / "reasoner.json").read_text("utf-8"))["figures"]["generation/kept"] == 0.5


def test_what_cannot_start_is_one_line_and_status_2(run: Path, out: Path, base: Path, tmp_path: Path) -> None:
    where = ["--data", run, "--out", out]
    (tmp_path / "empty").mkdir()
    for more, said in (
        (["--preset", "paper"], "name its folder with --set base=DIR"),
        (["--preset", "paper", "--set", f"base={tmp_path / 'empty'}"], "empty: has no readable model"),
        (["--preset", "paper", "--set", f"base={base}"], "reads 2000 tokens, expected max_tokens 5000"),
        (["--set", f"tokenizer={tmp_path / 'empty'}"], "empty: has no readable tokenizer"),
        (["--set", "shares.task=2.0"], "expected at most 1"),
        (["--set", "packing=true"], "setting train_reasoner.packing is not known; did you mean packs?"),
        (["--set", "precision=float16"], "expected bfloat16 or float32"),
        (["--set", "max_tokens=10"], "no example in the split train"),
        (["--preset", "tiny"], "reasoner preset 'tiny' is not known"),
        (["--workers", "2"], "expected a multiple of --workers 2"),
        (["--workers", "2", "--dry-run"], "expected a multiple of --workers 2"),
    ):
        result = invoke(*where, *more)
        assert result.exit_code == 2, more
        assert said in result.stderr
        assert result.stderr.splitlines()[-1].startswith("error: ")
    result = invoke("--data", tmp_path / "empty", "--out", tmp_path / "none")
    assert result.exit_code == 2
    assert "no table samples" in result.stderr
    assert not (tmp_path / "none").exists()


def test_the_plan_says_what_would_be_done_and_keeps_nothing(run: Path, tmp_path: Path) -> None:
    where = ["--data", run, "--out", tmp_path / "out", "--set", "network.layers=2", "--set", "network.hidden=64"]
    printed = invoke(*where, "--dry-run")
    assert printed.exit_code == 0, printed.stderr
    plan = json.loads(printed.stdout)
    counts = plan["examples"]["train"]
    assert sum(plan["examples"]["validation"].values()) > 0
    assert counts["task"] == counts["important"] == counts["secondary"] > 0
    assert plan["tokens"]["secondary"]["prompt_mean"] > plan["tokens"]["task"]["prompt_mean"]
    assert plan["tokens"]["secondary"]["longest"] > plan["tokens"]["secondary"]["prompt_mean"]
    assert plan["tokens"]["secondary"]["too_long"] == 0
    assert 0 <= plan["padding"] < 1
    assert plan["steps"] > 0
    memory = plan["memory_bytes"]
    assert memory["weights"] == memory["gradients"] == 4 * memory["num_weights"]
    assert memory["weights"] < memory["optimizer"] < 2 * memory["weights"]  # Muon keeps one average, AdamW two
    assert memory["checkpoint"] == memory["weights"] + memory["optimizer"]
    adamw = json.loads(invoke(*where, "--set", "optimizer=adamw", "--dry-run").stdout)["memory_bytes"]
    assert adamw["optimizer"] == 2 * adamw["weights"]
    assert memory["activations"] > 0
    assert plan["time"]["seconds"] > 0
    assert plan["time"]["how"].startswith("measured on ")
    assert not (tmp_path / "out").exists()


def test_the_plan_is_what_then_is_done(run: Path, out: Path) -> None:
    settings = replace(SETTINGS, steps=0, passes=2.0)
    planned = training_plan(job(run, out, settings), 0)
    job(run, out, settings, minutes=1e-9).run()
    manifest = json.loads((out / "manifest.json").read_text("utf-8"))
    assert planned["steps"] == manifest["settings"]["steps"]
    assert planned["examples_read"] == manifest["examples"]["train"]["used"]
    assert sum(of["total"] for of in planned["tokens"].values()) == manifest["examples"]["train"]["tokens"]
    assert planned["memory_bytes"]["num_weights"] == num_saved_weights(out)


@pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing.:FutureWarning")  # of peft about transformers
def test_memory_is_shared_and_lora_trains_little(run: Path, out: Path, base: Path) -> None:
    whole = training_plan(job(run, out, replace(SETTINGS, base=str(base))), 2)["memory_bytes"]
    alone = training_plan(job(run, out, replace(SETTINGS, base=str(base))), 0)["memory_bytes"]
    lora = replace(SETTINGS, base=str(base), lora=LoraSettings(4, 8))
    little = training_plan(job(run, out, lora), 0)["memory_bytes"]
    assert whole["weights"] == alone["weights"] / 2
    assert whole["gathered"] > alone["gathered"] == 0
    assert little["num_weights"] == alone["num_weights"] + little["num_trained"]
    job(run, out, lora, minutes=1e-9).run()
    assert little["num_trained"] == num_saved_weights(out)
    again = training_plan(job(run, out, replace(SETTINGS, base=str(base), recomputes=True)), 0)["memory_bytes"]
    assert again["activations"] < alone["activations"]


@pytest.mark.parametrize("name", ["embedded", pytest.param("mesatask", marks=pytest.mark.slow)])
def test_a_file_may_have_a_table_for_it(name: str, run: Path, tmp_path: Path) -> None:
    assert "train_reasoner" in SECTIONS
    workflow = ROOT / "workflows" / f"{name}.toml"
    result = invoke("--data", run, "--out", tmp_path / "out", "--config", workflow, "--dry-run", "--set", "network.layers=1")
    assert result.exit_code == 0, result.stderr


def test_the_tokenizer_of_another_training_may_be_taken(run: Path, out: Path, tmp_path: Path) -> None:
    tokenizer().save_pretrained(tmp_path / "words")
    settings = replace(SETTINGS, tokenizer=str(tmp_path / "words"), steps=1)
    job(run, out, settings).run()
    assert AutoTokenizer.from_pretrained(out / "weights").get_vocab() == tokenizer().get_vocab()
