"""Schemas, and rows to and from dataclasses."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.errors import ConfigError, Notice
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.card import MetricCard
from stable_data.scene import UPRIGHT, Relation, RelationKind, Scene, SceneObject, Stage, SupportFrame, Tabletop, TaskInfo
from stable_data.storage.scene_arrays import scenes_from_table
from stable_data.storage.schema_checks import check_schema
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.storage.table_rows import (
    arrow_table,
    card_from_row,
    card_row,
    notice_row,
    object_row,
    scene_from_row,
    scene_row,
)

_text = st.text(max_size=12)
_finite = st.floats(-1e3, 1e3)
_length = st.floats(1e-6, 1e3)
_json = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False) | _text,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(_text, inner, max_size=2),
    max_leaves=4,
)
_source = st.none() | st.dictionaries(_text, _json, max_size=3)
_relation = st.builds(Relation, _text, st.sampled_from(RelationKind), _text)
_conditions = st.lists(
    st.builds(GoalCondition, _text.filter(bool), st.sampled_from(ConditionKind), _text, st.none() | _length, st.booleans()),
    max_size=2,
).map(tuple)
_relations = st.lists(_relation, max_size=3).map(tuple)
_texts = st.lists(_text, max_size=3).map(tuple)


@st.composite
def _tilt(draw: st.DrawFn) -> tuple[float, ...]:
    q = draw(st.tuples(*[st.floats(-1, 1)] * 4))
    norm = math.sqrt(sum(x * x for x in q))
    return tuple(x / norm for x in q) if norm > 1e-3 else UPRIGHT


def _objects() -> st.SearchStrategy[tuple[SceneObject, ...]]:
    one = st.builds(
        SceneObject,
        instance=_text.filter(lambda name: name != "table"),
        category=_text,
        position=st.tuples(_finite, _finite, _finite),
        yaw=_finite,
        size=st.tuples(_length, _length, _length),
        asset_id=st.none() | _text,
        scale=st.none() | st.tuples(_length, _length, _length),
        tilt_quat_xyzw=_tilt(),
        description=_text,
        stage=st.none() | st.sampled_from(Stage),
        support=st.none() | _text,
        source=_source,
    )
    return st.lists(one, max_size=4, unique_by=lambda o: o.instance).map(tuple)


_zone = st.tuples(_finite, _length, _finite, _length).map(lambda z: (z[0], z[0] + 1 + z[1], z[2], z[2] + 1 + z[3]))
_frame = st.builds(SupportFrame, _text, _text, st.tuples(_finite, _finite, _finite), _finite, st.none() | _text)
_scene = st.builds(
    Scene,
    scene_id=_text,
    table=st.builds(Tabletop, _text, st.tuples(_length, _length), st.none() | _zone, st.none() | _length),
    objects=_objects(),
    task=st.none()
    | st.builds(TaskInfo, _text, _text, _texts, _texts, _texts, _texts, _relations, _text, _source, conditions=_conditions),
    relations=_relations,
    source=_source,
    fixed=st.frozensets(_text, max_size=2),
    frame=st.none() | _frame,
)


def table_of(scenes: list[Scene]) -> pa.Table:
    blank = dict.fromkeys(SCHEMAS["scenes"].names)
    return arrow_table("scenes", [blank | scene_row(scene) for scene in scenes])


def through_parquet(table: pa.Table) -> pa.Table:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    return pq.read_table(pa.BufferReader(sink.getvalue()))


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(st.lists(_scene, max_size=3))
def test_scenes_go_through_parquet_unchanged(scenes: list[Scene]) -> None:
    table = through_parquet(table_of(scenes))
    back = [scene_from_row(row) for row in table.to_pylist()]
    assert back == scenes
    assert [scene.source for scene in back] == [scene.source for scene in scenes]
    assert [o.source for scene in back for o in scene.objects] == [o.source for scene in scenes for o in scene.objects]
    assert [scene.task and scene.task.source for scene in back] == [scene.task and scene.task.source for scene in scenes]
    assert scenes_from_table(table) == scenes  # column by column, without the sources


def test_real_scenes_go_through_parquet_unchanged(real_data: Path) -> None:
    dataset = MesaTaskDataset(real_data)
    scenes = [dataset.read(scene_id)[0] for scene_id in dataset.scene_ids]
    table = through_parquet(table_of(scenes))
    back = [scene_from_row(row) for row in table.to_pylist()]
    assert back == scenes == scenes_from_table(table)
    assert [o.source for scene in back for o in scene.objects] == [o.source for scene in scenes for o in scene.objects]
    sliced = table.slice(3, 5)
    assert scenes_from_table(sliced) == scenes[3:8]


def test_words_of_other_languages_survive() -> None:
    cup = SceneObject(
        "1_杯子_0", "杯子", (0.1, 0.2, 0.3), 0.0, (0.1, 0.1, 0.1), description="чашка ☕ \u0000\n", source={"é": ["😀"]}
    )
    scene = Scene("szene_ß", Tabletop("tisch", (1.0, 0.5)), (cup,))
    [row] = through_parquet(table_of([scene])).to_pylist()
    back = scene_from_row(row)
    assert back == scene
    assert back.objects[0].source == {"é": ["😀"]}
    assert json.loads(row["objects"][0]["source_json"]) == {"é": ["😀"]}


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_every_column_says_what_it_means(name: str) -> None:
    for column in SCHEMAS[name]:
        assert column.metadata[b"meaning"].strip(), column.name
        assert b"unit" in column.metadata, column.name


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_the_meanings_survive_parquet(name: str) -> None:
    schema = through_parquet(arrow_table(name, [])).schema
    assert schema.equals(SCHEMAS[name])
    assert schema.metadata == SCHEMAS[name].metadata
    assert [column.metadata for column in schema] == [column.metadata for column in SCHEMAS[name]]
    check_schema(schema, name, name)


@pytest.mark.parametrize("version", [str(TABLE_VERSION - 1), str(TABLE_VERSION + 1), None])
def test_a_table_of_another_version_is_refused(version: str | None) -> None:
    metadata = None if version is None else {"stable_data.version": version}
    with pytest.raises(ConfigError, match=rf"run/scenes: written as table version {version or 'none'}, expected") as caught:
        check_schema(SCHEMAS["scenes"].with_metadata(metadata), "scenes", "run/scenes")
    assert caught.value.code == "table_version"


def test_a_row_that_lacks_a_column_is_our_mistake() -> None:
    with pytest.raises(AssertionError, match="source_json"):
        arrow_table("scenes", [{name: None for name in SCHEMAS["scenes"].names if name != "source_json"}])


def test_every_field_has_a_column() -> None:
    scene = Scene("s", Tabletop("t", (1.0, 1.0)), (SceneObject("a", "b", (0, 0, 0), 0, (1, 1, 1)),), TaskInfo("e", "t"))
    row = scene_row(scene)
    assert set(row) < set(SCHEMAS["scenes"].names)
    assert set(object_row(scene.objects[0])) - {"source_json"} == {f.name for f in fields(SceneObject)} - {"source"}
    assert "source_json" not in object_row(scene.objects[0], with_source=False)
    assert set(row["task"]) - {"source_json"} == {f.name for f in fields(TaskInfo)} - {"source"}
    assert scene_row(replace(scene, task=None))["task"] is None


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_a_card_comes_back(data: st.DataObject) -> None:
    values: dict[str, Any] = {}
    for column in fields(MetricCard):
        kind = str(column.type)
        plain = st.booleans() if "bool" in kind else st.integers(0, 99) if "int" in kind else st.floats(0, 1e6)
        values[column.name] = data.draw(plain | st.none() if "None" in kind else plain, label=column.name)
    card = MetricCard(**values)
    blank = dict.fromkeys(SCHEMAS["scenes"].names)
    [row] = through_parquet(arrow_table("scenes", [blank | card_row(card)])).to_pylist()
    assert card_from_row(row) == card


def test_a_notice_is_a_row_of_warnings_and_of_failures() -> None:
    row = notice_row(Notice("office_table_0031", "read", "glb_missing", "object 2_cup_0 has no mesh"))
    for name in ("warnings", "failures"):
        assert arrow_table(name, [row]).to_pylist() == [row]


def test_numbers_that_json_does_not_have_become_null_in_a_source() -> None:
    source = {"mass": math.nan, "parts": [1.5, math.inf, {"x": -math.inf}], "name": "é"}
    row = object_row(SceneObject("a", "b", (0, 0, 0), 0, (1, 1, 1), source=source))
    assert json.loads(row["source_json"], parse_constant=pytest.fail) == {
        "mass": None,
        "parts": [1.5, None, {"x": None}],
        "name": "é",
    }
