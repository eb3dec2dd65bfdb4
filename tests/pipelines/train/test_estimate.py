from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from transformers import Qwen3Config

from models.semantic_reasoner.training.settings import EMBEDDED, LanguageModelSettings, LoraSettings, ReasonerTrainingSettings
from models.training.distributed import CPU, ProcessContext
from pipelines.train.estimate import memory_bytes
from tests.models.semantic_reasoner.training.reasoner_examples import TINY, tokenizer
from tests.models.semantic_reasoner.training.sharded_runs import (
    DATA,
    in_processes,
    memory_of,
    of_base,
    trainer,
    write_base,
)

ROWS = [[20], [21], [22], [23]]
EXACT = ("weights", "gradients", "optimizer")
BOUND = 0.05
"""How far the planned activations may be from those that autograd keeps."""

BASE_CASES: dict[str, dict[str, Any]] = {
    "full": {},
    "recomputes": {"recomputes": True},
    "bfloat16": {"precision": "bfloat16"},
    "bfloat16_recomputes": {"precision": "bfloat16", "recomputes": True},
    "lora": {"lora": LoraSettings(2, 8), "recomputes": True},
    "bfloat16_lora": {"lora": LoraSettings(2, 8), "precision": "bfloat16"},
    "muon": {"optimizer": "muon"},
}
pytestmark = pytest.mark.filterwarnings("ignore:.is_gradient_checkpointing.:FutureWarning")  # of peft about transformers


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_base(tmp_path_factory.mktemp("base"))


def planned(settings: ReasonerTrainingSettings, world: int) -> dict[str, int]:
    tokens = len(ROWS) * int(DATA.length[[row[0] for row in ROWS]].max())
    replies = int(DATA.reply_length[[row[0] for row in ROWS]].sum())
    return memory_bytes(settings, tokenizer(), tokens, replies, world)


def measured(settings: ReasonerTrainingSettings, place: ProcessContext) -> dict[str, int]:
    made = trainer(settings, place)
    made.advance()
    return memory_of(made, ROWS)


def settings_of(case: str, base: Path, place: ProcessContext) -> ReasonerTrainingSettings:
    return replace(of_base(replace(TINY, accumulate=4), base, place), **BASE_CASES[case])


def compare(found: dict[str, int], plan: dict[str, int]) -> None:
    assert {name: found[name] for name in EXACT} == {name: plan[name] for name in EXACT}
    assert plan["activations"] == pytest.approx(found["activations"], rel=BOUND)


@pytest.mark.parametrize("case", BASE_CASES)
def test_the_plan_of_one_process_is_what_it_holds(case: str, base: Path) -> None:
    settings = settings_of(case, base, CPU)
    compare(measured(settings, CPU), planned(settings, 1))


@pytest.mark.parametrize("precision", [pytest.param("bfloat16", marks=pytest.mark.slow), "float32"])
@pytest.mark.parametrize(
    "network",
    [
        pytest.param(LanguageModelSettings(), id="embedded"),
        pytest.param(
            LanguageModelSettings(layers=3, heads=8, key_value_heads=8, head=32, intermediate=512),
            id="other",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_plan_of_a_network_from_scratch_is_what_it_holds(network: LanguageModelSettings, precision: Any) -> None:
    settings = replace(EMBEDDED, steps=8, network=network, precision=precision, max_tokens=512)
    compare(measured(settings, CPU), planned(settings, 1))


def measured_in_all(place: ProcessContext, base: Path) -> dict[str, dict[str, int]]:
    return {case: measured(settings_of(case, base, place), place) for case in BASE_CASES}


@pytest.mark.slow
@pytest.mark.parametrize("world", [2, 4])
def test_the_plan_of_several_processes_is_what_the_first_holds(world: int, base: Path) -> None:
    found = in_processes(world, measured_in_all, base)
    for case in BASE_CASES:
        plan = planned(settings_of(case, base, CPU), world)
        compare(found[0][case], plan)
        assert all(part[case][name] <= plan[name] for part in found for name in EXACT)
        whole = planned(settings_of(case, base, CPU), 1)["weights"]
        assert sum(part[case]["weights"] for part in found) == whole


def test_the_plan_of_a_large_network_needs_no_weights(tmp_path: Path) -> None:
    """Of Qwen3-8B only the configuration is there."""
    write_qwen3_8b(tmp_path)
    settings = replace(TINY, base=str(tmp_path), precision="bfloat16", recomputes=True)
    alone, shared = (memory_bytes(settings, tokenizer(), 20_000, 8_000, world) for world in (1, 8))
    assert alone["num_weights"] == alone["num_trained"] == 8_190_735_360
    assert alone["weights"] == 4 * alone["num_weights"] == 8 * shared["weights"]
    assert shared["each_process"] < 80e9
    lora = memory_bytes(replace(settings, lora=LoraSettings(16, 32)), tokenizer(), 20_000, 8_000, 8)
    assert lora["num_trained"] == 43_646_976
    assert lora["each_process"] < shared["each_process"]
    assert alone["gathered"] == 0


def write_qwen3_8b(folder: Path) -> None:
    Qwen3Config(
        vocab_size=151_936,
        hidden_size=4096,
        num_hidden_layers=36,
        num_attention_heads=32,
        num_key_value_heads=8,
        head_dim=128,
        intermediate_size=12_288,
        max_position_embeddings=40_960,
        tie_word_embeddings=False,
        architectures=["Qwen3ForCausalLM"],
    ).save_pretrained(folder)
