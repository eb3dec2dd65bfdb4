"""Conditions on the rows of a table as text, such as ``stable and num_stacked >= 2``.

A condition compares columns with constants and joins the comparisons with ``and``, ``or`` and ``not``. Python's parser reads
it, but no part of it is executed. Arrow evaluates it, and skips the parts of a file whose statistics exclude it. A row with an
unknown value (null) does not pass: if stability was never judged, neither ``stable`` nor ``not stable`` is true. Only
``is None`` and ``is not None`` test for null: ``aws is None or aws >= 1`` also selects rows with unknown ``aws``.

The length, the levels and the comparisons of a condition are limited (:class:`stable_data.limits.TextLimits`). Many comparisons
side by side, and lists of many constants, are one level.
"""

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import reduce
from operator import and_, eq, ge, gt, le, lt, ne, or_
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from stable_data.errors import ConfigError
from stable_data.limits import LIMITS, at_most

_WIDEST = 8  # maximum number of operands in one chain of Arrow's expression
_LONGEST_SHOWN = 200  # maximum number of characters of a condition in a message

_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], pc.Expression]] = {
    ast.Eq: eq,
    ast.NotEq: ne,
    ast.Lt: lt,
    ast.LtE: le,
    ast.Gt: gt,
    ast.GtE: ge,
}


@dataclass(frozen=True, eq=False)
class FilterExpression:
    """A condition on rows.

    Attributes:
        text: The text of the condition.
        columns: The columns that it names, in the order of their first mention.
        expression: The Arrow expression; true, false, or null if it depends on unknown values.
    """

    text: str
    columns: tuple[str, ...]
    expression: pc.Expression

    def rows(self, table: pa.Table) -> pa.Table:
        """Returns the rows of a table that pass."""
        return table.filter(self.expression)

    def passes(self, row: Mapping[str, Any], schema: pa.Schema) -> bool:
        """Whether one row passes.

        Args:
            row: Column -> value; columns other than :attr:`columns` may be missing.
            schema: Schema of its table.
        """
        columns = pa.schema([schema.field(name) for name in self.columns])
        return len(self.rows(pa.Table.from_pylist([{name: row[name] for name in self.columns}], columns))) == 1


def parse_filter(text: str, schema: pa.Schema) -> FilterExpression:
    """Parses a condition.

    Args:
        text: Such as ``stable and num_stacked >= 2``, ``table_type in ["office_table", "desk"]``, ``0 < float_rate <= 0.1`` or
            ``aws is None or aws >= 1``.
        schema: Schema of the table; the condition may name its columns of numbers, strings and booleans.

    Raises:
        ConfigError: The text cannot be parsed, is too long or too deep, has too many comparisons, or names an unknown column
            (``query_invalid``).
    """
    if len(text) > LIMITS.text.max_query:
        raise _invalid(text, f"has {len(text)} characters, expected {at_most(LIMITS.text, 'max_query')}; use several queries")
    tree: ast.expr | None
    try:
        # A condition may have several lines; spaces within its text constants stay as they are.
        tree = ast.parse(" ".join(text.strip().splitlines()), mode="eval").body
    except (SyntaxError, ValueError) as error:
        raise _invalid(text, f"cannot be read ({getattr(error, 'msg', error)})") from error
    except (RecursionError, MemoryError):
        tree = None  # too deep for Python's parser
    if tree is None or _is_deep(tree):
        levels = at_most(LIMITS.text, "max_query_levels", "levels")
        raise _invalid(text, f"nests deeper, expected {levels}; use fewer parentheses")
    if (terms := _num_terms(tree)) > LIMITS.text.max_query_terms:
        most = at_most(LIMITS.text, "max_query_terms")
        raise _invalid(
            text, f"has {terms:,} comparisons and operands of and, or, expected {most}; use a list: scene_id in [...]"
        )
    reader = _Reader(text, schema)
    try:
        expression = reader.truth(tree)
        ds.InMemoryDataset(schema.empty_table()).to_table(filter=expression)  # raises if types cannot be compared
    except ConfigError:
        raise
    except pa.ArrowException as error:
        raise _invalid(text, f"compares values of different types ({str(error).partition(chr(10))[0]})") from error
    except (OverflowError, ValueError) as error:
        raise _invalid(
            text, f"has a value that no column can contain ({error}), expected 64-bit integers and Unicode text"
        ) from error
    if not reader.columns:
        raise _invalid(text, "names no column; omit the condition to select all rows")
    return FilterExpression(text, tuple(reader.columns), expression)


class _Reader:
    """Converts a syntax tree to an Arrow expression."""

    def __init__(self, text: str, schema: pa.Schema) -> None:
        self._text, self._schema = text, schema
        self._names = [f.name for f in schema if not pa.types.is_nested(f.type)]
        self.columns: dict[str, None] = {}

    def truth(self, node: ast.expr) -> pc.Expression:
        """Converts a node with a boolean value."""
        if isinstance(node, ast.BoolOp):
            return _joined(and_ if isinstance(node.op, ast.And) else or_, [self.truth(value) for value in node.values])
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return ~self.truth(node.operand)
        if isinstance(node, ast.Compare):
            return self._compared(node)
        if isinstance(node, ast.Name):
            if not pa.types.is_boolean(self._schema.field(self._column(node)).type):
                raise _invalid(self._text, f"uses {node.id} as a boolean, expected a comparison")
            return pc.field(node.id)
        if isinstance(node, ast.Constant) and isinstance(node.value, bool):
            return pc.scalar(node.value)
        raise _invalid(self._text, f"has {_quoted(node)} where a boolean expression is expected")

    def _compared(self, node: ast.Compare) -> pc.Expression:
        sides = [node.left, *node.comparators]
        return _joined(and_, [self._comparison(*each) for each in zip(sides, node.ops, sides[1:], strict=False)])

    def _comparison(self, left: ast.expr, operator: ast.cmpop, right: ast.expr) -> pc.Expression:
        if isinstance(operator, ast.In | ast.NotIn):
            found = _is_in(self._value(left), self._constants(right))
            return found if isinstance(operator, ast.In) else ~found
        if isinstance(operator, ast.Is | ast.IsNot):
            if not isinstance(left, ast.Name) or not isinstance(right, ast.Constant) or right.value is not None:
                found = _quoted(ast.Compare(left, [operator], [right]))
                raise _invalid(self._text, f"has {found}, expected a column before is and None after it")
            value = self._value(left)
            return value.is_null() if isinstance(operator, ast.Is) else value.is_valid()
        return _COMPARISONS[type(operator)](self._value(left), self._value(right))

    def _value(self, node: ast.expr) -> pc.Expression:
        if isinstance(node, ast.Name):
            return pc.field(self._column(node))
        return pc.scalar(self._constant(node))

    def _constants(self, node: ast.expr) -> list[Any]:
        if not isinstance(node, ast.List | ast.Tuple | ast.Set) or not node.elts:
            raise _invalid(self._text, f"has {_quoted(node)} after in, expected a list of constants")
        return [self._constant(item) for item in node.elts]

    def _constant(self, node: ast.expr) -> Any:
        try:
            value = ast.literal_eval(node)
        except (ValueError, TypeError) as error:
            raise _invalid(self._text, f"has {_quoted(node)}, expected a column or a constant") from error
        if value is None:
            raise _invalid(self._text, "compares with None; write is None or is not None for unknown values")
        if not isinstance(value, str | int | float) or value != value:
            raise _invalid(self._text, f"has {_quoted(node)}, expected a number, a string or a boolean")
        return value

    def _column(self, node: ast.Name) -> str:
        if node.id not in self._names:
            name = _quoted(node)[1:-1]
            near = get_close_matches(name, self._names, 3, 0.5)
            expected = " or ".join(near) if near else f"one of {', '.join(self._names)}"
            raise _invalid(self._text, f"names {name}, expected {expected}")
        self.columns[node.id] = None
        return node.id


def _joined(operation: Callable[[Any, Any], Any], parts: list[pc.Expression]) -> pc.Expression:
    """Joins expressions with logarithmic depth, since Arrow recurses into an expression on the C++ stack.

    Arrow flattens nested operations of the same kind into one chain. A double negation separates the groups.
    """
    while len(parts) > _WIDEST:
        parts = [~~reduce(operation, parts[start : start + _WIDEST]) for start in range(0, len(parts), _WIDEST)]
    return reduce(operation, parts)


def _is_in(value: pc.Expression, constants: list[Any]) -> pc.Expression:
    """Whether a value equals one of some constants; null if the value is null.

    ``isin`` alone is false for null, compares different types, and distinguishes -0.0 from 0.0. So one comparison for each
    type of constant is added: with zero, if zero is among the constants.
    """
    parts = []
    for kind in dict.fromkeys(map(type, constants)):
        alike = [constant for constant in constants if type(constant) is kind]
        compared = next((constant for constant in alike if constant == 0), alike[0])
        parts += [value.isin(pa.array(alike)), value == pc.scalar(compared)]
    return _joined(or_, parts)


def _is_deep(tree: ast.expr) -> bool:
    """Whether a syntax tree has too many levels: the reader in this module and the evaluation in Arrow recurse once per level."""
    level: list[ast.AST] = [tree]
    for _ in range(LIMITS.text.max_query_levels):
        level = [child for node in level for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
        if not level:
            return False
    return True


def _num_terms(tree: ast.expr) -> int:
    """The number of comparisons, and of operands of ``and`` and ``or``: Arrow takes some 70 microseconds for each."""
    return sum(
        len(node.ops) if isinstance(node, ast.Compare) else len(node.values) if isinstance(node, ast.BoolOp) else 0
        for node in ast.walk(tree)
    )


def _quoted(words: ast.AST | str) -> str:
    """Quotes text for a message: on one line, of bounded length."""
    text = repr(words if isinstance(words, str) else ast.unparse(words))
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."


def _invalid(text: str, why: str) -> ConfigError:
    return ConfigError(f"query {_quoted(text)} {why}", "query_invalid")
