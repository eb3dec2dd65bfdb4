"""The rate job: every scene has one rating or one failure, resumed, by rules and by a model that sees pictures."""

import base64
import io
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from models.scene_rating.prompt import PROMPT_VERSION
from models.scene_rating.settings import RatingSettings
from models.scene_rating.symbolic_judge import rules_version
from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import describe
from pipelines.execution.shard_step import Shard
from pipelines.rate.job import RateJob, rate
from pipelines.rate.settings import RateSettings
from pipelines.rate.shard import RateStep
from stable_data.errors import ConfigError
from stable_data.rating.criteria import KEYS
from stable_data.scene import Scene, Tabletop, TaskInfo
from stable_data.storage.run_folder import RunFolder
from tests.models.scene_rating.cases import SCORES, reply_for, scene_named
from tests.models.semantic_reasoner.engines.endpoint import Act, Endpoint, closed_url, endpoint, error, said
from tests.stable_data.export.runs import thing, write_run

pytestmark = pytest.mark.sim

TABLE = Tabletop("dining_table", (1.0, 0.7))
HERE = WorkerPool()
CATEGORIES = ("can", "mug", "plate")


def scene(name: str, **more: Any) -> Scene:
    """A can, a mug and a plate on a table; the task names the scene."""
    objects = (
        thing("can/0", "0_can_0", 0.3, 0.3, 0.0),
        thing("mug/0", "1_mug_0", 0.6, 0.3, 0.0),
        thing("plate/0", "2_plate_0", 0.45, 0.5, 0.0),
    )
    return replace(Scene(name, TABLE, objects, TaskInfo("", f"Rate {name}. Put the can on the plate.")), **more)


COLLIDING = scene("c", objects=(*scene("c").objects[:2], thing("plate/0", "2_plate_0", 0.32, 0.32, 0.0)))
SCENES = (scene("a"), scene("b", task=None), COLLIDING, scene("d"), scene("e"))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(write_run(tmp_path_factory.mktemp("run") / "run", SCENES).root)


def by_model(server: Endpoint, **more: Any) -> RateSettings:
    rating = RatingSettings("openai:m", **{"http": server.settings(prompt_price=1.0, tries=1, rest_s=0.0), **more})
    return RateSettings(rating, picture_size=256, scenes_per_shard=2)


def ratings(out: Path) -> dict[str, Mapping[str, Any]]:
    rows = RunFolder(str(out)).table("ratings").to_pylist()
    assert len({row["scene_id"] for row in rows}) == len(rows)
    return {row["scene_id"]: row for row in rows}


def answer(words: str, number: int, body: Any) -> Act:
    return Act(body=said(reply_for(scene_named(words))))


def test_rules_rate_every_scene_and_what_is_unknown_has_its_reason(run: Path, tmp_path: Path) -> None:
    manifest = rate(str(run), str(tmp_path / "out"), RateSettings(scenes_per_shard=2), HERE)
    rows = ratings(tmp_path / "out")
    assert sorted(rows) == list("abcde")
    assert {row["judge_version"] for row in rows.values()} == {rules_version(CATEGORIES)}
    assert (rows["a"]["clean"], rows["c"]["clean"]) == (True, False)
    assert rows["c"]["ppi"] < rows["a"]["ppi"] == 10.0
    assert rows["a"]["quality_pass"] is True
    assert rows["c"]["quality_pass"] is False
    assert (rows["b"]["cwt"], rows["b"]["average"], rows["b"]["quality_pass"]) == (None, None, None)
    assert rows["b"]["code"] == "criterion_unknown"
    assert "no instruction" in rows["b"]["reason"]
    assert rows["b"]["ppi"] == 10.0  # it is known, but in no average
    counts = manifest["counts"]
    assert (counts["ratings"], counts["rated"], counts["failures"], counts["passed"], counts["passes_known"]) == (5, 4, 0, 3, 4)
    assert counts["unknown"] == {"cwt": 1, "osr": 0, "ppi": 0, "lcr": 0, "ov": 0}
    known = [row for row in rows.values() if row["average"] is not None]
    assert counts["average"] == pytest.approx(np.mean([row["average"] for row in known]), abs=1e-3)
    page = (tmp_path / "out" / "report" / "index.html").read_text("utf-8")
    assert "criterion_unknown" in page
    assert "4 / 5" in page


def test_a_model_sees_two_pictures_of_each_scene_and_gives_the_rows(run: Path, tmp_path: Path) -> None:
    with endpoint(answer) as server:
        manifest = rate(str(run), str(tmp_path), by_model(server), HERE)
        assert server.tries.total() == 4  # that without a task is not asked about
        (body,) = [body for body in server.bodies if "Rate c." in json.dumps(body)]
    rows = ratings(tmp_path)
    assert {key: rows["a"][key] for key in KEYS} == SCORES
    assert (rows["a"]["average"], rows["a"]["quality_pass"], rows["c"]["quality_pass"]) == (pytest.approx(9.2), True, False)
    assert (rows["a"]["judge"], rows["a"]["judge_version"], rows["a"]["cwt_rationale"]) == (
        "openai:m",
        PROMPT_VERSION,
        "It is 9.",
    )
    assert (rows["a"]["prompt_tokens"], rows["a"]["cost"]) == (20, pytest.approx(20e-6))
    assert (rows["b"]["code"], rows["b"]["average"], rows["b"]["tries"]) == ("task_missing", None, 0)
    assert (manifest["counts"]["average"], manifest["counts"]["prompt_tokens"]) == (9.2, 80)
    urls = [part["image_url"]["url"] for part in body["messages"][1]["content"][1:]]
    front, perspective = (np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition("base64,")[2])))) for url in urls)
    assert front.shape == perspective.shape == (256 + 24, 256, 3)
    assert front[:256].std() > 5
    assert (front[:256] != perspective[:256]).mean() > 0.2


def test_a_stopped_run_goes_on_and_asks_nothing_twice(run: Path, tmp_path: Path) -> None:
    with endpoint(answer) as server:
        settings = by_model(server)
        server.plan = lambda words, number, body: (
            Act(401, error("wrong key")) if scene_named(words) == "d" else answer(words, number, body)
        )
        with pytest.raises(ConfigError) as stopped:
            rate(str(run), str(tmp_path), settings, HERE)
        assert stopped.value.code == "engine_off"
        assert set(ratings(tmp_path)) == {"a", "b"}
        asked = dict(server.tries)
        server.plan = answer
        rate(str(run), str(tmp_path), settings, HERE)
        assert sorted(ratings(tmp_path)) == list("abcde")
        assert all(server.tries[words] == n for words, n in asked.items() if scene_named(words) == "a")
        whole = server.tries.total()
        rate(str(run), str(tmp_path), settings, HERE)
        assert server.tries.total() == whole
        moved = replace(settings, rating=replace(settings.rating, http=replace(settings.rating.http, base_url=closed_url())))
        rate(str(run), str(tmp_path), moved, HERE)  # the address shapes no rows
        with pytest.raises(ConfigError, match="tries: 3 -> 2"):
            rate(str(run), str(tmp_path), replace(settings, rating=replace(settings.rating, tries=2)), HERE)


def test_kept_replies_give_the_same_rows_without_the_endpoint(run: Path, tmp_path: Path) -> None:
    with endpoint(answer) as server:
        settings = by_model(server, cache=str(tmp_path / "cache"))
        rate(str(run), str(tmp_path / "one"), settings, HERE, report=False)
        asked = server.tries.total()
        server.plan = lambda *_: Act(500, b"")
        rate(str(run), str(tmp_path / "two"), settings, HERE, report=False)
        assert server.tries.total() == asked
    assert ratings(tmp_path / "one") == ratings(tmp_path / "two")


def test_bad_replies_are_unknown_rows_and_the_run_ends_well(run: Path, tmp_path: Path) -> None:
    def plan(words: str, number: int, body: Any) -> Act:
        return Act(body=said("It looks nice, 9 of 10.")) if "Rate d." in json.dumps(body) else answer(words, number, body)

    with endpoint(plan) as server:
        manifest = rate(str(run), str(tmp_path), by_model(server), HERE)
    rows = ratings(tmp_path)
    assert (rows["d"]["code"], rows["d"]["tries"], rows["d"]["average"]) == ("reply_not_json", 3, None)
    assert [rows["d"][key] for key in KEYS] == [None] * 5
    assert manifest["counts"]["unknown_by_code"] == {"task_missing": 1, "reply_not_json": 1}
    assert (manifest["counts"]["rated"], manifest["counts"]["average"]) == (3, 9.2)


def test_a_scene_that_cannot_be_used_is_a_failure_with_a_reason(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(geometry: Any, *_: Any) -> Any:
        raise ValueError(f"odd mesh in {geometry.scene.scene_id}")

    monkeypatch.setattr("pipelines.rate.shard.RatingCase.of", broken)
    manifest = rate(str(run), str(tmp_path), RateSettings(), HERE)
    failures = RunFolder(str(tmp_path)).table("failures").to_pylist()
    assert sorted(row["id"] for row in failures) == list("abcde")
    assert {(row["step"], row["code"]) for row in failures} == {("audit", "unexpected")}
    assert (manifest["counts"]["failures"], manifest["counts"]["average"]) == (5, None)


@pytest.mark.slow
def test_items_in_processes_of_their_own_have_the_same_rows(run: Path) -> None:
    step, shard = RateStep(str(run), RateSettings()), Shard("0" * 16, ("a", "c"))
    assert step.shard(shard, isolated=True).rows == step.shard(shard).rows


def test_a_condition_chooses_scenes_and_a_dry_run_writes_nothing(run: Path, tmp_path: Path) -> None:
    chosen = RateJob(str(run), RateSettings(), "scene_id == 'd'")
    assert describe(chosen)["num_scenes"] == 1
    rate(str(run), str(tmp_path / "out"), RateSettings(), HERE, where="scene_id == 'd'")
    assert set(ratings(tmp_path / "out")) == {"d"}
    with pytest.raises(ConfigError, match="has no scenes"):
        RateJob(str(run), RateSettings(), "scene_id == 'z'")


def test_the_command_rates_counts_and_refuses(run: Path, tmp_path: Path) -> None:
    shared = ["rate", "--scenes", str(run), "--out", str(tmp_path / "out"), "--workers", "0"]
    done = CliRunner().invoke(app, [*shared, "--where", "scene_id == 'a'"])
    assert done.exit_code == 0, done.output
    assert "symbolic rated 1 of 1 scenes, average " in done.output
    assert "1 of 1 pass; 0 unknown, 0 failures" in done.output
    for options, message in (
        (["--judge", "gpt-4o"], "expected symbolic, openai:MODEL or scripted:FILE"),
        (["--judge", "openai:m", "--set", "rating.http.key_variable=NO_SUCH_KEY"], "NO_SUCH_KEY is not set"),
        (["--set", "rating.picture=1"], "did you mean"),
        (["--set", "picture_size=64"], "picture_size is 64, expected at least 256"),
        (["--scenes", str(tmp_path / "absent")], "absent"),
    ):
        done = CliRunner().invoke(app, [*shared, *options])
        assert done.exit_code == 2, done.output
        assert message in " ".join(done.stderr.split())


def test_a_script_can_stand_for_a_model(run: Path, tmp_path: Path) -> None:
    (tmp_path / "script.json").write_text(json.dumps({f"Rate {name}.": json.loads(reply_for(name)) for name in "acde"}))
    settings = RateSettings(RatingSettings(f"scripted:{tmp_path / 'script.json'}"), picture_size=256)
    manifest = rate(str(run), str(tmp_path / "out"), settings, HERE, report=False)
    assert (manifest["counts"]["rated"], manifest["counts"]["judge"]) == (4, "scripted")


@pytest.mark.slow
@pytest.mark.ray
def test_a_run_on_ray_gives_the_same_rows(run: Path, tmp_path: Path) -> None:
    settings = RateSettings(scenes_per_shard=2)
    rate(str(run), str(tmp_path / "here"), settings, HERE, report=False)
    rate(str(run), str(tmp_path / "ray"), settings, WorkerPool(1), report=False)
    assert {p.name: p.read_bytes() for p in (tmp_path / "here" / "ratings").iterdir()} == {
        p.name: p.read_bytes() for p in (tmp_path / "ray" / "ratings").iterdir()
    }
    shutil.rmtree(tmp_path / "ray")
