"""Conditions against Python's own reading of the same words."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import ConfigError
from stable_data.limits import LIMITS
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.schemas import SCHEMAS

SCHEMA = pa.schema(
    [("n", pa.int64()), ("x", pa.float64()), ("ok", pa.bool_()), ("kind", pa.string()), ("many", pa.list_(pa.int64()))]
)
ROWS = st.fixed_dictionaries(
    {
        "n": st.none() | st.integers(-2, 4),
        "x": st.none() | st.sampled_from([-0.5, 0.0, 0.1, 1.0]),
        "ok": st.none() | st.booleans(),
        "kind": st.none() | st.sampled_from(["desk", 'it\'s "odd"', ""]),
    }
)
ATOMS = st.sampled_from(
    [
        "ok",
        "n > 1",
        "n == 0",
        "n != 2",
        "0 <= n < 3",
        "x <= 0.1",
        "x > n",
        "kind == 'desk'",
        "kind in ['desk', 'shelf']",
        "n not in (1, 2)",
        "n in [2.0, 0.5, 3]",
        "x in [0.1, -0.0]",
        "ok not in [False]",
        "x is None",
        "kind is not None",
        "ok is None or ok",
    ]
)
CONDITIONS = st.recursive(
    ATOMS,
    lambda inner: (
        st.builds("({} and {})".format, inner, inner)
        | st.builds("({} or {})".format, inner, inner)
        | st.builds("not ({})".format, inner)
    ),
    max_leaves=6,
)


def truth(text: str, row: dict[str, Any]) -> bool | None:
    """Kleene's logic over Python's own comparisons: None is unknown."""
    import ast

    def of(node: ast.expr) -> bool | None:
        if isinstance(node, ast.BoolOp):
            parts = [of(value) for value in node.values]
            decides = isinstance(node.op, ast.Or)
            return decides if decides in parts else None if None in parts else not decides
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            inner = of(node.operand)
            return None if inner is None else not inner
        if isinstance(node, ast.Compare) and len(node.ops) > 1:
            sides = [node.left, *node.comparators]
            links: list[ast.expr] = [
                ast.Compare(one, [operator], [other]) for one, operator, other in zip(sides, node.ops, sides[1:], strict=False)
            ]
            return of(ast.BoolOp(ast.And(), links))
        if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.Is | ast.IsNot):
            return bool(eval(ast.unparse(node), {}, row))  # noqa: S307 - what is unknown is known to be so
        names = [n.id for n in ast.walk(node) if isinstance(n, ast.Name)]
        if any(row[name] is None for name in names):
            return None
        return bool(eval(ast.unparse(node), {}, row))  # noqa: S307 - our own words

    return of(ast.parse(text, mode="eval").body)


@given(CONDITIONS, ROWS)
def test_a_row_passes_where_the_condition_is_surely_true(text: str, row: dict[str, Any]) -> None:
    assert parse_filter(text, SCHEMA).passes(row, SCHEMA) == (truth(text, row) is True)


@given(CONDITIONS, st.lists(ROWS, max_size=6))
def test_a_table_is_filtered_row_by_row(text: str, rows: list[dict[str, Any]]) -> None:
    query = parse_filter(text, SCHEMA)
    table = pa.Table.from_pylist(rows, SCHEMA)
    assert query.rows(table).to_pylist() == [row | {"many": None} for row in rows if query.passes(row, SCHEMA)]


@pytest.mark.parametrize(
    ("text", "values", "groups"),
    [
        ("x is None", [None, None, None], [0, 2]),
        ("x is not None", [0.5, 1.0, 0.2], [1, 2]),
        ("not (x is None)", [0.5, 1.0, 0.2], [1, 2]),
        ("x is None or x >= 1", [None, None, 1.0, None], [0, 1, 2]),
        ("x is not None and x < 1", [0.5, 0.2], [1, 2]),
        ("x < 1", [0.5, 0.2], [1, 2]),
        ("not x < 1", [1.0], [1]),
        ("x in [0.5, 0.2]", [0.5, 0.2], [1, 2]),
        ("not x in [0.5, 0.2]", [1.0], [1, 2]),
    ],
)
def test_a_file_is_opened_where_its_statistics_leave_it_open(
    text: str, values: list[float | None], groups: list[int], tmp_path: Path
) -> None:
    path, schema = tmp_path / "x.parquet", pa.schema([("x", pa.float64())])
    pq.write_table(pa.table({"x": [None, None, 0.5, 1.0, None, 0.2]}, schema), path, row_group_size=2)
    query, [fragment] = parse_filter(text, schema), ds.dataset(path).get_fragments()
    assert ds.dataset(path).to_table(filter=query.expression)["x"].to_pylist() == values
    assert query.rows(pq.read_table(path))["x"].to_pylist() == values
    assert [group.id for group in fragment.subset(query.expression).row_groups] == groups


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "cannot be read"),
        ("ok and", "cannot be read"),
        ("ok; ok", "cannot be read"),
        ("(" * 5000, "cannot be read"),
        ("stable > 0.5", "names stable, expected one of n, x, ok, kind"),
        ("many == 1", "names many"),
        ("n", "expected a comparison"),
        ("n + 1 > 2", "expected a column or a constant"),
        ("__import__('os').system('true')", "where a boolean expression is expected"),
        ("n is 3", "has 'n is 3', expected a column before is and None after it"),
        ("n is not kind", "has 'n is not kind', expected a column before is and None after it"),
        ("None is n", "has 'None is n', expected a column before is and None after it"),
        ("n is None is None", "has 'None is None', expected a column before is and None after it"),
        ("many is None", "names many"),
        ("n == None", "compares with None; write is None or is not None"),
        ("n in [1, None]", "compares with None; write is None or is not None"),
        ("n in [1j]", "expected a number, a string or a boolean"),
        ("n in kind", "expected a list of constants"),
        ("n in []", "expected a list of constants"),
        ("n > 'many'", "values of different types"),
        ("n in [1, 'a']", "values of different types"),
        ("n in [1, True]", "values of different types"),
        ("kind in [1]", "values of different types"),
        ("ok in [1]", "values of different types"),
        ("ok" + " or ok" * LIMITS.text.max_query, "expected at most"),
        ("n" + " == 1" * 150_000, "has 150,000 comparisons and operands of and, or, expected at most 40,000"),
        ("ok" + " or ok" * 100_000, "has 100,001 comparisons and operands of and, or, expected at most 40,000"),
        ("not " * LIMITS.text.max_query_levels + "ok", "nests deeper"),
        ("not " * 900 + "ok", "nests deeper"),
        ("not " * 90_000 + "ok", "nests deeper"),
        ("(" * 900 + "ok" + ")" * 900, "cannot be read"),
        ("1 + " * 90_000 + "n > 1", "nests deeper"),
        ("n" + ".n" * 90_000, "nests deeper"),
        (f"n in '{'a' * 90_000}'", "expected a list of constants"),
        ("n" * 90_000, "names nnn"),
        ("True", "names no column"),
        ("n < 99999999999999999999", "a value that no column can contain"),
        ("-99999999999999999999 in [n]", "a value that no column can contain"),
        ("n in [1, 99999999999999999999]", "a value that no column can contain"),
        (f"n + 0x{'f' * 5000} > 1", "a value that no column can contain"),
        (r"'\ud800' == kind", "a value that no column can contain"),
        (r"kind in ['\ud800']", "a value that no column can contain"),
        ("kind == '\ud800'", "cannot be read"),
    ],
)
def test_what_is_no_condition_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_filter(text, SCHEMA)
    assert caught.value.code == "query_invalid"
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 700


def nested(width: int, depth: int) -> str:
    """A condition that is ``ok``: so deep, and so wide on each level, the deepest part first."""
    text = "ok"
    for level in range(1, depth):
        text = f"({text})" + (" and ok" if level % 2 else " or n < 0") * width
    return text


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        (" and ".join(["ok"] * 10_000), [0, 1]),
        (" or ".join(f"n == {number}" for number in range(1, 10_001)), [1, 2]),
        (" or ".join(["ok and x is not None", *["n < 0 and x < n"] * 100]), [0]),
        ("0 <= n" + " <= n" * 1_000 + " <= 1", [0, 1]),
        (f"kind in {[f'scene_{number:05d}' for number in range(10_000)]}", [0, 1]),
        (f"kind not in {[f'scene_{number:05d}' for number in range(10_000)]}", [2]),
        ("not " * (LIMITS.text.max_query_levels // 2 * 2 - 2) + "ok", [0, 1]),
        (nested(64, LIMITS.text.max_query_levels - 1), [0, 1]),
    ],
)
def test_long_conditions_are_answered(text: str, numbers: list[int]) -> None:
    rows: list[dict[str, Any]] = [
        {"n": 0, "x": -0.0, "ok": True, "kind": "scene_00000"},
        {"n": 1, "x": None, "ok": True, "kind": "scene_09999"},
        {"n": 10_000, "x": 1.0, "ok": False, "kind": "desk"},
        {"n": None, "x": None, "ok": None, "kind": None},
    ]
    table = pa.Table.from_pylist(rows, SCHEMA)
    assert parse_filter(text, SCHEMA).rows(table)["n"].to_pylist() == [rows[number]["n"] for number in numbers]


def test_a_list_takes_both_zeros() -> None:
    table = pa.table({"x": [0.0, -0.0, None]}, pa.schema([("x", pa.float64())]))
    for text in ("x in [0.0, 1.0]", "x in [-0.0, 1.0]", "x in [1, 0]"):
        assert parse_filter(text, SCHEMA).rows(table).num_rows == 2


def test_the_columns_of_the_card_can_be_asked_for() -> None:
    query = parse_filter("clean and num_stacked >= 2", SCHEMAS["scenes"])
    assert query.columns == ("clean", "num_stacked")
    row = {"clean": True, "num_stacked": 2}
    assert query.passes(row, SCHEMAS["scenes"])
    assert not query.passes(row | {"num_stacked": 1}, SCHEMAS["scenes"])
    assert not query.passes(row | {"clean": None}, SCHEMAS["scenes"])


def test_what_is_unknown_passes_where_it_is_asked_for_and_nowhere_else() -> None:
    schema = SCHEMAS["scenes"]
    assert [parse_filter("aws >= 1", schema).passes({"aws": aws}, schema) for aws in (None, 0.5, 1.0)] == [False, False, True]
    lenient = parse_filter("aws is None or aws >= 1", schema)
    assert [lenient.passes({"aws": aws}, schema) for aws in (None, 0.5, 1.0)] == [True, False, True]
    assert not parse_filter("(aws is None or aws >= 1) and stable", schema).passes({"aws": None, "stable": None}, schema)


def test_spaces_in_a_text_are_kept_and_lines_are_joined() -> None:
    table = pa.table({"kind": ["a  b", "a b"]}, pa.schema([("kind", pa.string())]))
    assert parse_filter("kind ==\n 'a  b'", SCHEMA).rows(table)["kind"].to_pylist() == ["a  b"]
