"""What a reasoner is put together from, and what its proposals are said to depend on."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from models.semantic_reasoner.engines.http_settings import HttpSettings
from models.semantic_reasoner.engines.protocol import Sampling
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings, load_reasoner, proposal_config
from models.semantic_reasoner.language.category_statistics import FILE
from models.semantic_reasoner.replies.checks import CheckSettings
from models.semantic_reasoner.text.reply_json import render_objects
from stable_data.errors import ConfigError
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, ask, thing

URL = "http://127.0.0.1:1/v1"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "model"
    made.mkdir()
    (made / "config.json").write_text("{}")
    (made / "model.safetensors").write_bytes(b"0")
    return made


def test_proposals_depend_on_the_content_of_a_model_and_not_on_its_place(folder: Path, tmp_path: Path) -> None:
    one = proposal_config(EngineSettings(f"transformers:{folder}"))
    assert json.loads(json.dumps(one)) == one
    moved = folder.rename(tmp_path / "elsewhere")
    assert proposal_config(EngineSettings(f"transformers:{moved}")) == one
    for name, content in (("model.safetensors", b"1"), ("tokenizer.json", b"{}"), ("config.json", b"{ }")):
        (moved / name).write_bytes(content)
        other = proposal_config(EngineSettings(f"transformers:{moved}"))
        assert other != one
        one = other


def test_they_depend_on_how_it_is_asked_and_not_on_how_patiently() -> None:
    http = HttpSettings(URL, "default")
    engine, settings = EngineSettings("openai:large", http=http), ReasonerSettings()
    one = proposal_config(engine, settings)
    others = [
        (replace(engine, engine="openai:small"), settings),
        (replace(engine, sampling=Sampling(temperature=0.1)), settings),
        (replace(engine, http=replace(http, extra='{"top_k": 5}')), settings),
        (engine, replace(settings, tries=5)),
        (engine, replace(settings, checks=CheckSettings(overhang_cm=3.0))),
    ]
    found = [proposal_config(*other) for other in others]
    assert all(other != one for other in found)
    patient = replace(http, base_url="http://127.0.0.1:2/v1", tries=3, read_s=1.0)
    assert proposal_config(replace(engine, http=patient, cache="kept", num_slots=3), settings) == one


def test_statistics_of_another_folder_count(folder: Path, tmp_path: Path) -> None:
    STATISTICS.save(tmp_path / "known")
    engine = EngineSettings("openai:large", http=HttpSettings(URL, "default"))
    with_them = proposal_config(engine, ReasonerSettings(statistics=str(tmp_path / "known")))
    assert with_them != proposal_config(engine)
    assert (tmp_path / "known" / FILE).is_file()


@pytest.mark.parametrize(
    ("engine", "said"),
    [
        ("transformers:nowhere", "config.json: cannot be read"),
        ("vllm:nowhere", "expected a Hugging Face folder"),
        ("scripted:no.json", "expected a script"),
    ],
)
def test_an_engine_that_is_not_there_is_said_before_anything_is_asked(engine: str, said: str, tmp_path: Path) -> None:
    kind, _, name = engine.partition(":")
    with pytest.raises(ConfigError, match=said) as caught:
        proposal_config(EngineSettings(f"{kind}:{tmp_path / name}"))
    assert caught.value.code == "engine_missing"


def test_a_key_that_is_not_set_is_said_before_anything_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("A_KEY", raising=False)
    engine = EngineSettings("openai:large", http=HttpSettings(URL, "default", key_variable="A_KEY"))
    with pytest.raises(ConfigError, match="A_KEY is not set"):
        proposal_config(engine)
    monkeypatch.setenv("A_KEY", "very-secret")
    assert "very-secret" not in json.dumps(proposal_config(engine))


def test_paths_are_settled_for_any_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    here = tmp_path.resolve()
    settled = EngineSettings("transformers:model", cache="kept").settled()
    assert (settled.engine, settled.cache) == (f"transformers:{here / 'model'}", str(here / "kept"))
    for engine in ("embedded", "openai:large"):
        assert EngineSettings(engine).settled() == EngineSettings(engine)
    assert ReasonerSettings(statistics="run").settled().statistics == str(here / "run")
    assert ReasonerSettings(statistics="s3://bucket/run").settled().statistics == "s3://bucket/run"


def test_without_statistics_names_are_checked_and_with_them_all_else(tmp_path: Path) -> None:
    far = render_objects([thing("mug_0", 300, 30)], ())
    (tmp_path / "script.json").write_text(json.dumps(['{"remove":["cup_0"],"objects":[]}', far] * 2))
    STATISTICS.save(tmp_path / "known")
    question = ask("Move the mug.", "edit", [thing("mug_0", 30, 30)])
    engine = EngineSettings(f"scripted:{tmp_path / 'script.json'}")
    bare, none = load_reasoner(engine, ReasonerSettings(tries=2))
    (p,) = bare.propose([question], [0])
    assert none is None
    assert [f.code for r in p.refused for f in r.faults] == ["removed_unknown"]
    assert [o.instance for o in p.objects] == ["mug_0"]
    strict, _ = load_reasoner(engine, ReasonerSettings(tries=2, statistics=str(tmp_path / "known")))
    (p,) = strict.propose([question], [0])
    assert [f.code for r in p.refused for f in r.faults] == ["removed_unknown", "off_table"]
    assert p.code == "reply_unusable"


def test_never_to_ask_is_refused() -> None:
    with pytest.raises(ConfigError, match="tries is 0"):
        ReasonerSettings(tries=0)
