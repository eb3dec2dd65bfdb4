"""The judge that sees pictures, against a local endpoint: what it sends, what it reads, and what stays unknown."""

import base64
import io
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from models.scene_rating.pictures import captioned, picture_number
from models.scene_rating.prompt import FORM, NUMBERS, PROMPT_VERSION, SYSTEM, rating_messages
from models.scene_rating.rating_case import RatingCase
from models.scene_rating.reply import read_rating
from models.scene_rating.settings import RatingSettings, load_judge
from models.scene_rating.vision_judge import VisionJudge
from models.semantic_reasoner.engines.openai_engine import OpenAIEngine
from models.semantic_reasoner.engines.protocol import OFF, Completion
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from stable_data.errors import ConfigError, SceneError
from stable_data.rating.criteria import CRITERIA, KEYS
from stable_data.rating.rating import summarise_ratings
from tests.models.scene_rating.cases import SCORES, picture, pictured_case, reply_for, scene_named
from tests.models.semantic_reasoner.engines.endpoint import Act, closed_url, endpoint, error, said

NUMBERS_OF_A = {name: picture_number("a", name) for name in NUMBERS}


def test_the_prompt_and_the_form_have_all_criteria_and_a_version() -> None:
    assert PROMPT_VERSION == "c38f67132eab3de7", "the texts changed: ratings of the old prompt are another version"
    properties = FORM.schema()["properties"]
    assert list(properties) == [*NUMBERS.values(), *KEYS]
    for c in CRITERIA:
        assert c.name in SYSTEM
        assert c.judged in SYSTEM
        assert list(properties[c.key]["properties"]) == ["rationale", "score"]  # the reason comes first
        assert properties[c.key]["properties"]["score"]["enum"] == [k / 2 for k in range(2, 21)]
    _, user = rating_messages(pictured_case("a").scene)
    for words in ("Rate a.", "An office.", "office table, 120 x 60 cm", "front view"):
        assert words in user["content"]


def test_a_question_has_the_two_pictures_with_their_numbers_below() -> None:
    with endpoint(lambda *_: Act(body=said(reply_for("a")))) as server:
        settings = server.settings(prompt_price=2.0, reply_price=10.0)
        (rating,) = VisionJudge(OpenAIEngine(settings)).rate([pictured_case("a")])
        (body,) = server.bodies
    assert {key: rating.score(key) for key in KEYS} == SCORES
    assert rating.average == pytest.approx(9.2)
    assert rating.quality_pass is True
    assert rating.scores["cwt"].rationale == "It is 9."
    assert (rating.judge, rating.version, rating.tries) == ("openai:m", PROMPT_VERSION, 1)
    assert (rating.prompt_tokens, rating.reply_tokens) == (20, 5)
    assert rating.cost == pytest.approx(90e-6)
    assert body["response_format"]["json_schema"] == {"name": "rating", "strict": True, "schema": FORM.schema()}
    text, *urls = body["messages"][1]["content"]
    assert text["text"].startswith("Task: Rate a.")
    for url, shade, name in zip(urls, (200, 90), NUMBERS, strict=True):
        content = base64.b64decode(url["image_url"]["url"].partition("base64,")[2])
        sent = np.asarray(Image.open(io.BytesIO(content)))
        assert (sent[:96] == shade).all()
        assert (sent == captioned(picture(shade), name, NUMBERS_OF_A[name])).all()
    assert str(NUMBERS_OF_A["front"]) not in json.dumps(body["messages"][0]) + text["text"]


def test_numbers_below_pictures_are_legible_and_differ() -> None:
    numbers = {picture_number(f"s{k}", name) for k in range(50) for name in NUMBERS}
    assert numbers <= set(range(100, 1000))
    assert len(numbers) > 80
    one, other = (captioned(picture(0), "front", number)[96:] for number in (123, 456))
    assert one.shape[0] >= 24
    assert (one < 128).any()
    assert (one != other).any()


def test_many_scenes_are_asked_about_at_once_and_each_has_its_own_rating() -> None:
    def plan(words: str, number: int, body: dict[str, Any]) -> Act:
        name = scene_named(words)
        return Act(body=said(reply_for(name, dict.fromkeys(KEYS, 1 + int(name[1:]) % 10))), after_s=0.05)

    with endpoint(plan) as server:
        ratings = VisionJudge(OpenAIEngine(server.settings(concurrency=8))).rate([pictured_case(f"s{k}") for k in range(24)])
        assert 1 < server.most_under_way <= 8
    assert [(r.scene_id, r.average) for r in ratings] == [(f"s{k}", 1 + k % 10) for k in range(24)]


def test_bad_replies_are_asked_again_with_the_reason_and_the_same_pictures() -> None:
    bad = [reply_for("a", {**SCORES, "ov": 11}), "The scene is fine.", reply_for("a")]
    with endpoint(lambda words, number, body: Act(body=said(bad[len(server.bodies) - 1]))) as server:
        (rating,) = VisionJudge(OpenAIEngine(server.settings()), tries=3).rate([pictured_case("a")])
        first, second, third = server.bodies
    assert rating.average == pytest.approx(9.2)
    assert (rating.tries, rating.prompt_tokens) == (3, 60)
    assert '"ov" has score 11' in second["messages"][-1]["content"]
    assert "not JSON" in third["messages"][-1]["content"]
    assert third["messages"][1] == first["messages"][1]
    assert len({body["seed"] for body in (first, second, third)}) == 3


BAD = {
    "out of range": reply_for("a", {**SCORES, "cwt": 0}),
    "above": reply_for("a", {**SCORES, "lcr": 10.5}),
    "no half": reply_for("a", {**SCORES, "cwt": 7.3}),
    "text": reply_for("a", {**SCORES, "cwt": "nine"}),
    "truth": reply_for("a", {**SCORES, "cwt": True}),
    "null": reply_for("a", {**SCORES, "cwt": None}),
    "infinite": reply_for("a").replace('"score": 9.5', '"score": 1e999'),
    "not a number": reply_for("a").replace('"score": 9.5', '"score": NaN'),
    "four criteria": reply_for("a", {key: SCORES[key] for key in KEYS[:4]}),
    "bare scores": reply_for("a", {}, **{key: float(score) for key, score in SCORES.items()}),
    "no reason": reply_for("a").replace("It is 9.5.", " "),
    "a list": json.dumps([9, 9, 9, 9, 9]),
    "words": "I would give it a 9 out of 10.",
    "cut": reply_for("a")[:-30],
    "blind": reply_for("a", number_below_front=0),
    "another scene": reply_for("b"),
    "no number": reply_for("a").replace("number_below_perspective", "number"),
}


@pytest.mark.parametrize("what", BAD)
def test_what_is_no_rating_is_unknown_and_never_a_number(what: str) -> None:
    with endpoint(lambda *_: Act(body=said(BAD[what]))) as server:
        judge = VisionJudge(OpenAIEngine(server.settings()), tries=2)
        bad, good = judge.rate([pictured_case("a"), replace(pictured_case("a"), clean=None)])
        assert len(server.bodies) == 4
    assert (bad.average, bad.quality_pass, dict(bad.scores)) == (None, None, {})
    assert bad.code == ("pictures_not_seen" if what in ("blind", "another scene", "no number") else bad.code)
    assert bad.code in ("reply_malformed", "reply_not_json", "pictures_not_seen")
    assert bad.reason.startswith("a: 2 answers could not be used, the last because ")
    assert "\n" not in bad.reason
    assert (bad.tries, bad.prompt_tokens) == (2, 40)
    assert good.code == bad.code


def test_a_model_without_sight_is_not_told_the_numbers() -> None:
    with endpoint(lambda *_: Act(body=said(BAD["blind"]))) as server:
        VisionJudge(OpenAIEngine(server.settings()), tries=3).rate([pictured_case("a")])
        texts = [
            m["content"] if isinstance(m["content"], str) else m["content"][0]["text"] for m in server.bodies[-1]["messages"]
        ]
    assert "look at both again" in texts[-1]
    assert not any(str(NUMBERS_OF_A["front"]) in text for text in texts)


REFUSALS = {
    "request_refused": Act(400, error("This model does not support image input")),
    "reply_refused": Act(
        body={"choices": [{"message": {"refusal": "I cannot."}}], "usage": {"prompt_tokens": 7, "completion_tokens": 2}}
    ),
    "reply_filtered": Act(body={"choices": [{"message": {"content": "x"}, "finish_reason": "content_filter"}]}),
    "response_invalid": Act(body=b"<html>oops</html>"),
}


@pytest.mark.parametrize("code", REFUSALS)
def test_a_refusal_is_unknown_for_its_scene_and_the_others_go_on(code: str) -> None:
    def plan(words: str, number: int, body: dict[str, Any]) -> Act:
        return REFUSALS[code] if "Rate a." in json.dumps(body["messages"]) else Act(body=said(reply_for("b")))

    with endpoint(plan) as server:
        refused, other = VisionJudge(OpenAIEngine(server.settings())).rate([pictured_case("a"), pictured_case("b")])
    asked = 3 if code.startswith("reply_") else 1  # another seed may have an answer
    assert (refused.code, refused.average, refused.tries) == (code, None, asked)
    assert refused.reason.startswith("a: ")
    assert other.average == pytest.approx(9.2)
    assert summarise_ratings([refused, other]).average == pytest.approx(9.2)


def test_a_cut_reply_is_asked_for_again() -> None:
    cut = {"choices": [{"message": {"content": "{"}, "finish_reason": "length"}]}
    with endpoint(lambda *_: Act(body=said(reply_for("a")) if len(server.bodies) > 1 else cut)) as server:
        (rating,) = VisionJudge(OpenAIEngine(server.settings())).rate([pictured_case("a")])
    assert rating.average == pytest.approx(9.2)
    assert rating.tries == 2
    (unknown,) = VisionJudge(ScriptedEngine([Completion("", failure="cut", code="reply_cut")] * 2), 2).rate(
        [pictured_case("a")]
    )
    assert (unknown.code, unknown.tries) == ("reply_cut", 2)


def test_a_scene_without_pictures_or_task_is_unknown_and_not_asked_about() -> None:
    cases = [
        pictured_case("a", front=None),
        pictured_case("a", perspective=None),
        pictured_case("a", task=" "),
        replace(pictured_case("a"), scene=replace(pictured_case("a").scene, task=None)),
        pictured_case("a", task="x" * 3000),
    ]
    engine = ScriptedEngine([])
    ratings = VisionJudge(engine).rate(cases)
    assert [r.code for r in ratings] == ["picture_missing"] * 2 + ["task_missing"] * 2 + ["instruction_invalid"]
    assert [r.average for r in ratings] == [None] * 5
    assert not engine.requests


@pytest.mark.parametrize("bad", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((4, 4, 4), np.uint8), "front.png"])
def test_what_is_no_picture_is_refused(bad: Any) -> None:
    with pytest.raises(SceneError, match="expected \\(H, W, 3\\) uint8") as caught:
        pictured_case("a", front=bad)
    assert caught.value.code == "picture_invalid"


def test_an_endpoint_that_is_down_says_so_for_every_scene() -> None:
    settings = RatingSettings("openai:m", http=replace(RatingSettings().http, base_url=closed_url(), tries=1))
    ratings = load_judge(settings).rate([pictured_case("a"), pictured_case("b")])
    assert {r.code for r in ratings} == {"endpoint_down"}
    assert "endpoint_down" in OFF


def test_replies_are_kept_and_read_again_whatever_the_endpoint_says_then(tmp_path: Path) -> None:
    with endpoint(
        lambda words, number, body: Act(body=said(reply_for(scene_named(words), dict.fromkeys(KEYS, 1 + number))))
    ) as server:
        settings = RatingSettings("openai:m", cache=str(tmp_path), http=server.settings())
        first, again = (load_judge(settings).rate([pictured_case("a"), pictured_case("b")]) for _ in range(2))
        assert server.tries.total() == 2
        other = load_judge(settings).rate([pictured_case("a", front=picture(1))])
    assert first == again
    assert [r.average for r in first] == [1.0, 1.0]
    assert other[0].average == 2.0  # another picture is another question


def test_an_azure_deployment_is_asked_with_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_KEY", "secret-key")
    with endpoint(lambda *_: Act(body=said(reply_for("a")))) as server:
        http = server.settings(base_url=server.url.removesuffix("/v1"), key_variable="SOME_KEY", azure_api_version="2024-10-21")
        (rating,) = load_judge(RatingSettings("openai:seer", http=http)).rate([pictured_case("a")])
        assert server.paths == ["/openai/deployments/seer/chat/completions?api-version=2024-10-21"]
    assert rating.average == pytest.approx(9.2)
    assert "secret-key" not in repr(rating)


@pytest.mark.parametrize("judge", ["", "gpt-4o", "symbolic:x", "openai:", "embedded", "transformers:folder"])
def test_judges_that_do_not_exist_are_refused(judge: str) -> None:
    with pytest.raises(ConfigError, match="expected symbolic, openai:MODEL or scripted:FILE"):
        RatingSettings(judge)


def test_what_shapes_ratings_is_in_the_settings_and_the_address_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    base = RatingSettings("openai:m")
    others = [
        replace(base, judge="openai:n"),
        replace(base, tries=2),
        replace(base, binds=False),
        replace(base, sampling=replace(base.sampling, temperature=0.5)),
        replace(base, http=replace(base.http, prompt_price=1.0)),  # prices are in the column of costs
        replace(base, http=replace(base.http, reply_price=1.0)),
    ]
    assert len({json.dumps(s.shaping(), sort_keys=True) for s in (base, *others)}) == 7
    assert replace(base, http=replace(base.http, base_url="http://elsewhere/v1", concurrency=2)).shaping() == base.shaping()
    assert base.shaping()["version"] == PROMPT_VERSION
    with pytest.raises(ConfigError, match="SOME_KEY is not set"):
        replace(base, http=replace(base.http, key_variable="SOME_KEY")).shaping()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from([1, 10, 5.5, 10**400]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from([*KEYS, *NUMBERS.values(), "score", "rationale"]), inner, max_size=8)
    ),
    max_leaves=20,
)
ENTRY = st.fixed_dictionaries({"rationale": st.text(max_size=5) | JSON, "score": st.sampled_from([1, 5.5, 7.3, 10, 11]) | JSON})
REPLY = st.fixed_dictionaries(
    {**dict.fromkeys(KEYS, ENTRY | JSON), **{NUMBERS[k]: st.just(n) for k, n in NUMBERS_OF_A.items()}}
)


@given(REPLY | JSON)
def test_any_document_is_five_scores_or_a_clear_error(data: Any) -> None:
    refused: SceneError | None = None
    try:
        found = read_rating(data, NUMBERS_OF_A)
    except SceneError as found_error:
        refused = found_error
    if refused is not None:
        assert refused.code in ("reply_malformed", "pictures_not_seen")
        assert "\n" not in str(refused)
        return
    assert list(found) == list(KEYS)
    assert all(
        one.score is not None and 1 <= one.score <= 10 and one.score % 0.5 == 0 and one.rationale for one in found.values()
    )


@pytest.mark.parametrize("around", ["%s", "```json\n%s\n```", "Here it is: %s I hope that helps.", "One {thing} first.\n%s"])
def test_words_and_fences_around_a_reply_are_skipped(around: str) -> None:
    (rating,) = VisionJudge(ScriptedEngine([around % reply_for("a")])).rate([pictured_case("a")])
    assert {key: one.score for key, one in rating.scores.items()} == SCORES


def test_a_scene_travels_to_another_process_without_its_geometry() -> None:
    sent = pickle.loads(pickle.dumps(pictured_case("a").without_geometry()))
    assert isinstance(sent, RatingCase)
    assert (sent.scene, sent.clean, sent.audited) == (pictured_case("a").scene, True, None)
