"""Trainings in several processes are those of one, and one goes on where several stopped."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from models.semantic_reasoner.training.sharding import make_loss
from models.training.distributed import CPU, ProcessContext
from tests.models.semantic_reasoner.training.reasoner_examples import TINY, tokenizer
from tests.models.semantic_reasoner.training.sharded_runs import (
    LORA,
    RECOMPUTES,
    advance,
    code_of_refusal,
    in_processes,
    of_base,
    trainer,
    whole_state,
    write_base,
    write_state,
)

CASES: dict[str, dict[str, Any]] = {
    "full": {},
    "lora": {"lora": LORA},
    "muon": {"optimizer": "muon"},
    "packed": {"packs": True},
    "bfloat16": {"precision": "bfloat16"},
    "bfloat16_lora": {"precision": "bfloat16", "lora": LORA},
}
TIED = replace(TINY, accumulate=4)  # a network from scratch, whose head is its embeddings
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing.:FutureWarning")  # of peft about transformers


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_base(tmp_path_factory.mktemp("base"))


def settings_of(case: str, base: Path, place: ProcessContext) -> Any:
    return TIED if case == "tied" else replace(of_base(RECOMPUTES, base, place), **CASES[case])


def buffers_of(case: str, base: Path, place: ProcessContext) -> dict[str, list[float]]:
    network = make_loss(settings_of(case, base, place), tokenizer(), place).network
    return {name: value.flatten().tolist() for name, value in network.named_buffers()}


def close(found: list[list[float]], expected: list[list[float]], case: str) -> bool:
    is_low = case.startswith("bfloat16")
    losses, norms = (2e-3, 2e-2) if is_low else (1e-5, 1e-3 if case == "muon" else 1e-5)
    pairs = list(zip(found, expected, strict=True))
    return all(a[0] == pytest.approx(b[0], rel=losses) and a[1] == pytest.approx(b[1], rel=norms) for a, b in pairs)


# --- two processes ------------------------------------------------------------------------------------------------------------


def run_in_two(place: ProcessContext, base: Path, folder: Path) -> dict[str, Any]:
    """Steps, a checkpoint and more steps; what another training of the same processes does from there; and refusals."""
    settings = settings_of("full", base, place)
    made = trainer(settings, place)
    losses = advance(made, 3)
    made.save(folder / "kept")
    write_state(made, folder / "state.safetensors")
    again = trainer(settings, place)
    assert again.resume(folder / "kept")
    on, on_again = advance(made, 2), advance(again, 2)
    ends = whole_state(made), whole_state(again)
    made.save(folder / "broken")
    if place.rank == 0:
        (file,) = (folder / "broken").glob("*/shard-00002-*")
        file.write_bytes(file.read_bytes()[:-64])
    torch.distributed.barrier()
    return {
        "losses": losses,
        "on": [on, on_again],
        "is_equal": all(torch.equal(value, ends[1][name]) for name, value in ends[0].items()),
        "buffers": buffers_of("full", base, place),
        "refusals": [
            code_of_refusal(lambda: trainer(settings, place, data="other").resume(folder / "kept")),
            code_of_refusal(lambda: again.resume(folder / "broken")),
        ],
        "none": again.resume(folder / "nowhere"),
    }


@pytest.mark.slow  # starts three processes, which a busy machine may end late
def test_two_processes_give_what_one_gives_and_one_goes_on(base: Path, tmp_path: Path) -> None:
    first, second = in_processes(2, run_in_two, base, tmp_path)
    assert first == second  # the losses are those of all processes
    alone = trainer(settings_of("full", base, CPU), CPU)
    assert close(first["losses"], advance(alone, 3), "full")
    assert first["is_equal"]
    assert first["on"][0] == first["on"][1]
    assert first["buffers"] == buffers_of("full", base, CPU)
    assert first["refusals"] == ["config_changed", "checkpoint_invalid"]
    assert first["none"] is False
    resumed = trainer(settings_of("full", base, CPU), CPU)
    assert resumed.resume(tmp_path / "kept")
    assert (resumed.step, resumed.tokens) == (alone.step, alone.tokens)
    state, kept = whole_state(resumed), load_file(tmp_path / "state.safetensors")
    assert state.keys() == kept.keys()
    assert all(torch.equal(value, kept[name]) for name, value in state.items())
    assert close(advance(resumed, 2), first["on"][0], "full")


# --- four processes and every way ---------------------------------------------------------------------------------------------


def run_cases(place: ProcessContext, base: Path, folder: Path) -> dict[str, Any]:
    found = {}
    for case in [*CASES, "tied"]:
        made = trainer(settings_of(case, base, place), place)
        losses = advance(made, 3)
        made.save(folder / case)
        write_state(made, folder / f"{case}.safetensors")
        found[case] = [losses, advance(made, 2), buffers_of(case, base, place)]
    return found


def resume_cases(place: ProcessContext, base: Path, folder: Path, out: Path) -> dict[str, Any]:
    found = {}
    for case in [*CASES, "tied"]:
        made = trainer(settings_of(case, base, place), place)
        assert made.resume(folder / case)
        write_state(made, out / f"{case}.safetensors")
        found[case] = advance(made, 2)
        made.save(out / case)
    return found


@pytest.mark.slow
def test_one_two_and_four_processes_train_alike_and_go_on_from_four(base: Path, tmp_path: Path) -> None:
    folders = {world: tmp_path / str(world) for world in (1, 2, 4, 12, 11)}
    for folder in folders.values():
        folder.mkdir()
    alone = run_cases(CPU, base, folders[1])
    two, four = (in_processes(world, run_cases, base, folders[world]) for world in (2, 4))
    assert all(part == two[0] for part in two)
    assert all(part == four[0] for part in four)
    for case, (losses, on, buffers) in alone.items():
        for found in (two[0][case], four[0][case]):
            assert close(found[0] + found[1], losses + on, case), case
            assert found[2] == buffers
    on_in_two = in_processes(2, resume_cases, base, folders[4], folders[12])[0]
    on_in_one = resume_cases(CPU, base, folders[4], folders[11])
    for case, (_, on, _) in four[0].items():
        kept = load_file(folders[4] / f"{case}.safetensors")
        for folder in (folders[12], folders[11]):
            state = load_file(folder / f"{case}.safetensors")
            assert state.keys() == kept.keys()
            assert all(torch.equal(value, kept[name]) for name, value in state.items()), case
        assert close(on_in_two[case], on, case), case
        assert close(on_in_one[case], on, case), case


@pytest.mark.slow
def test_each_process_writes_a_part(base: Path, tmp_path: Path) -> None:
    in_processes(4, run_one_and_save, base, tmp_path / "kept")
    (folder,) = (tmp_path / "kept").iterdir()
    files = sorted(folder.glob("*.safetensors"))
    assert [path.name[:11] for path in files] == [f"shard-0000{k}" for k in range(1, 5)]
    rows = []
    for path in files:
        with safe_open(path, framework="pt") as file:
            rows.append(file.get_slice("weights.model.embed_tokens.weight").get_shape()[0])
    whole = trainer(settings_of("full", base, CPU), CPU).loss.network.get_input_embeddings().weight
    assert rows == [len(whole) // 4] * 4
    notes = json.loads((folder / "training.json").read_text("utf-8"))
    assert notes["files"] == {path.name: path.stat().st_size for path in files}


def run_one_and_save(place: ProcessContext, base: Path, folder: Path) -> None:
    made = trainer(settings_of("full", base, place), place)
    advance(made, 1)
    made.save(folder)
