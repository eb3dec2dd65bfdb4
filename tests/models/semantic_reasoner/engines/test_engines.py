"""A layout from each engine passes the same tests: whatever answers, its replies have the form, follow their seed, fail alone."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from transformers import PreTrainedTokenizerFast, Qwen3ForCausalLM

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Completion, Engine, Request, Sampling
from models.semantic_reasoner.engines.registry import EMBEDDED, EngineSettings, load_engine
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.replies.grammar import HIGHEST_CM, ReplyGrammar
from models.semantic_reasoner.replies.to_scene import objects_of_reply
from models.semantic_reasoner.text.prompt import ReasonerQuestion, messages, user_message
from models.semantic_reasoner.text.reply_json import LayoutObject, parse_reply, render_objects
from models.semantic_reasoner.text.tokenizer import train_tokenizer
from models.semantic_reasoner.training.network import new_network
from models.semantic_reasoner.training.settings import LanguageModelSettings
from stable_data.errors import ConfigError, SceneError
from stable_data.scene import Stage, Tabletop
from tests.models.semantic_reasoner.engines.endpoint import answers_of, endpoint

ROOT = Path(__file__).parents[4]
TABLE = Tabletop("office_table", (1.12, 0.593))
ASK = ReasonerQuestion("Put the red mug on the plate.", TABLE, Stage.TASK)
FORM = ReplyGrammar.of_table(TABLE, at_least=1, at_most=1)
SHORT = Sampling(max_tokens=300)
TINY = LanguageModelSettings(hidden=32, layers=2, heads=4, key_value_heads=2, head=8, intermediate=64, vocabulary=300)
MUG = LayoutObject("mug_0", "a red mug", (9.0, 8.4, 10.0), (20.0, 30.5, 5.0), -15)
KINDS = ["embedded", "transformers", "openai", "scripted", "vllm"]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Hugging Face folder of a Qwen3 that has seen a few replies, so that its descriptions come to an end."""
    folder = tmp_path_factory.mktemp("models") / "tiny"
    tokenizer = train_tokenizer([user_message(ASK), render_objects([MUG])] * 4, 300)
    taught(new_network(TINY, tokenizer, 1024, seed=3), tokenizer).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    return folder


def taught(network: Qwen3ForCausalLM, tokenizer: PreTrainedTokenizerFast) -> Qwen3ForCausalLM:
    """A network after a moment of training on replies with a mug."""
    told = [render_objects([replace(MUG, position_cm=(10.0 * k + 5, 30.5, 5.0), z_rotation_deg=20 * k)]) for k in range(1, 9)]
    tokens = tokenizer([user_message(ASK) + text + str(tokenizer.eos_token) for text in told], add_special_tokens=False)[
        "input_ids"
    ]
    batch = torch.tensor([row[-40:] for row in tokens])
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-2)
    for _ in range(200):
        optimizer.zero_grad()
        network(input_ids=batch, labels=batch).loss.backward()
        optimizer.step()
    return network.eval()


def drawn(request: Request) -> str:
    """A layout that follows from the seed; what is too long is refused, as models do."""
    if len(request.messages[-1]["content"]) > 10_000:
        raise SceneError("the prompt is too long", "prompt_too_long")
    draws = np.random.default_rng(request.seed)
    form = request.form
    assert isinstance(form, ReplyGrammar)
    x, y = (round(float(draws.uniform(5, side)), 1) for side in (form.width_cm - 5, form.depth_cm - 5))
    return render_objects([LayoutObject("mug_0", "a mug", (9.0, 8.0, 10.0), (x, y, 5.0), int(draws.integers(-179, 181)))])


@pytest.fixture(scope="module", params=KINDS)
def engine(request: pytest.FixtureRequest, tiny: Path) -> Iterator[Engine]:
    kind = request.param
    if kind == "vllm":
        pytest.importorskip("vllm", reason="vllm is not installed: it wants an environment of its own and a GPU")
        yield load_engine(EngineSettings(f"vllm:{tiny}", SHORT, vllm='{"max_model_len": 1024}'))
    elif kind == "embedded":
        yield embedded()
    elif kind == "scripted":
        yield ScriptedEngine(drawn)
    elif kind == "transformers":
        yield load_engine(EngineSettings(f"transformers:{tiny}", SHORT))
    else:
        with endpoint(answers_of(load_engine(EngineSettings(f"transformers:{tiny}", SHORT)), FORM)) as server:
            yield load_engine(EngineSettings("openai:tiny", SHORT, http=server.settings(tries=1)))


def embedded() -> Engine:
    if not (EMBEDDED / "model.safetensors").is_file():
        pytest.skip("the weights of the embedded reasoner are not in this checkout")
    return load_engine(EngineSettings(sampling=SHORT))


def request(seed: int, ask: ReasonerQuestion = ASK) -> Request:
    return Request(tuple(messages(ask)), FORM, seed)


def test_its_replies_have_the_form_and_become_objects(engine: Engine) -> None:
    completions = engine.complete([request(seed) for seed in range(6)])
    said = [c for c in completions if not c.failure]
    assert said
    assert {c.code for c in completions} <= {"", "reply_cut"}  # an untrained model may never come to an end
    for completion in said:
        reply = parse_reply(completion.text)
        assert len(reply.objects) == 1
        assert render_objects(reply.objects) == completion.text
        for o in reply.objects:
            assert 0 <= o.position_cm[0] <= 112.0
            assert 0 <= o.position_cm[1] <= 59.3
            assert 0 <= o.position_cm[2] <= HIGHEST_CM
            assert max(o.size_cm) <= max(FORM.longest_cm, HIGHEST_CM)
            assert min(o.size_cm) > 0
        assert {o.stage for o in objects_of_reply(reply, ASK)} == {Stage.TASK}


def test_the_same_seed_says_the_same_and_another_another(engine: Engine) -> None:
    asked = [request(seed) for seed in range(1, 9)]
    first = engine.complete(asked)
    assert [c.text for c in engine.complete(asked)] == [c.text for c in first]
    assert len({c.text for c in first if c.text}) == len([c for c in first if c.text]) > 1


def test_what_cannot_be_asked_fails_and_leaves_the_others_alone(engine: Engine) -> None:
    long = Request(({"role": "user", "content": "mug " * 20_000},), FORM, 1)
    before, failed, after = engine.complete([request(1), long, request(2)])
    assert failed.code == "prompt_too_long"
    assert failed.text == ""
    assert "\n" not in failed.failure
    assert {before.code, after.code} <= {"", "reply_cut"}
    assert before.text != failed.text or before.failure
    assert engine.complete([]) == []


def test_a_served_engine_says_what_it_says_itself(tiny: Path) -> None:
    itself = load_engine(EngineSettings(f"transformers:{tiny}", SHORT))
    asked = [request(seed) for seed in range(4)]
    alone = [itself.complete([one])[0] for one in asked]  # in batches of one, as the endpoint answers
    with endpoint(answers_of(itself, FORM)) as server:
        served = load_engine(EngineSettings("openai:tiny", SHORT, http=server.settings(tries=1))).complete(asked)
    assert [replace(c, failure="") for c in served] == [replace(c, failure="") for c in alone]
    assert any(c.text for c in alone)


def test_each_kind_is_loaded_by_name(tiny: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.json"
    script.write_text(json.dumps({"red mug": {"objects": []}}))
    assert load_engine(EngineSettings(f"transformers:{tiny}")).name == "transformers:tiny"
    assert load_engine(EngineSettings(f"scripted:{script}")).complete([request(0)]) == [Completion('{"objects":[]}')]
    gpt = load_engine(EngineSettings("openai:gpt-4o"))
    assert gpt.name == "openai:gpt-4o"
    assert not gpt.repeats


def test_the_openai_client_is_loaded_by_its_own_engine_alone() -> None:
    code = "import sys, models.semantic_reasoner.engines.registry; print('openai' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "False\n"


def test_the_embedded_one_is_the_default() -> None:
    assert embedded().name == EngineSettings().engine == "embedded"


def test_a_cache_replays_what_was_said(tmp_path: Path) -> None:
    script = tmp_path / "script.json"
    script.write_text(json.dumps([{"objects": []}]))  # one reply, and no second
    cached = EngineSettings(f"scripted:{script}", cache=str(tmp_path / "cache"))
    (first,) = load_engine(cached).complete([request(0)])
    (again,) = load_engine(cached).complete([request(0)])
    assert (again.text, again.is_cached) == (first.text, True)


@pytest.mark.parametrize(
    ("more", "code"),
    [
        ({"engine": "gpt-4o"}, "config_invalid"),
        ({"engine": "embedded:large"}, "config_invalid"),
        ({"engine": "transformers:"}, "config_invalid"),
        ({"engine": ""}, "config_invalid"),
        ({"num_slots": 0}, "config_invalid"),
        ({"engine": "transformers:/nowhere/at/all"}, "model_invalid"),
        ({"engine": "scripted:/nowhere.json"}, "script_invalid"),
        ({"engine": "vllm:/nowhere", "vllm": "[]"}, None),
        ({"engine": "openai:gpt-4o", "http": HttpSettings("http://host/v1", "m", key_variable="NO_SUCH_KEY")}, "key_missing"),
    ],
)
def test_what_names_no_engine_is_refused_in_one_line(more: dict[str, object], code: str | None) -> None:
    with pytest.raises(ConfigError) as caught:
        load_engine(EngineSettings(**more))  # type: ignore[arg-type]
    assert code is None or caught.value.code == code
    assert "\n" not in str(caught.value)
    assert "expected" in str(caught.value) or "export" in str(caught.value)


def test_a_folder_that_is_no_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("no model")
    with pytest.raises(ConfigError) as caught:
        load_engine(EngineSettings(f"transformers:{tmp_path}"))
    assert caught.value.code == "model_invalid"
    assert str(tmp_path) in str(caught.value)


def test_vllm_says_what_it_needs(tiny: Path) -> None:
    try:
        import vllm  # noqa: F401
    except ImportError:
        with pytest.raises(ConfigError, match="separate environment") as caught:
            load_engine(EngineSettings(f"vllm:{tiny}"))
        assert caught.value.code == "extra_missing"
    else:
        pytest.skip("vllm is installed here")
