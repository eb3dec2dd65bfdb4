"""Conditions on the rows of a table, in words: ``stable and num_stacked >= 2``.

A condition names columns, compares them with constants and joins the comparisons with ``and``, ``or`` and ``not``. It is read
by Python's own parser and nothing of it is ever run; Arrow evaluates it, and skips the parts of a file whose statistics rule
it out. A value that is unknown (null) makes no row pass: neither ``stable`` nor ``not stable`` holds where stability was never
judged. Only ``is None`` and ``is not None`` ask for it: ``aws is None or aws >= 1`` takes what is unknown too.

A condition has at most :data:`LONGEST_QUERY` characters and :data:`DEEPEST_QUERY` levels. Many comparisons, and lists of many
constants, are one level.
"""

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import and_, eq, ge, gt, le, lt, ne, or_
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from stable_data.errors import ConfigError

LONGEST_QUERY = 1_000_000
"""Most characters of a condition: room for 10,000 ids of 96 characters each."""

DEEPEST_QUERY = 30
"""Most levels of a condition's syntax tree. The reader here and the evaluation in Arrow recurse once a level."""

_WIDEST = 8  # parts of one chain in Arrow's expression
_LONGEST_SHOWN = 200  # characters of a condition that a message repeats

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
        text: As it was written.
        columns: What it looks at, in the order of their first mention.
        expression: The same for Arrow; true, false, or null where it depends on what is unknown.
    """

    text: str
    columns: tuple[str, ...]
    expression: pc.Expression

    def rows(self, table: pa.Table) -> pa.Table:
        """Those rows of a table that pass."""
        return table.filter(self.expression)

    def passes(self, row: Mapping[str, Any], schema: pa.Schema) -> bool:
        """Whether one row does.

        Args:
            row: Column -> value; other columns than :attr:`columns` may be missing.
            schema: Of its table.
        """
        columns = pa.schema([schema.field(name) for name in self.columns])
        return len(self.rows(pa.Table.from_pylist([{name: row[name] for name in self.columns}], columns))) == 1


def parse_filter(text: str, schema: pa.Schema) -> FilterExpression:
    """A condition from its words.

    Args:
        text: Such as ``stable and num_stacked >= 2``, ``table_type in ["office_table", "desk"]``, ``0 < float_rate <= 0.1`` or
            ``aws is None or aws >= 1``.
        schema: The table's, whose columns of numbers, texts and truths may be named.

    Raises:
        ConfigError: It cannot be read, is too long or too deep, or names no such column (``query_invalid``).
    """
    if len(text) > LONGEST_QUERY:
        raise _invalid(text, f"has {len(text)} characters, expected at most {LONGEST_QUERY}; ask in several queries")
    tree: ast.expr | None
    try:
        # A condition may have several lines; spaces within its text constants stay as they are.
        tree = ast.parse(" ".join(text.strip().splitlines()), mode="eval").body
    except (SyntaxError, ValueError) as error:
        raise _invalid(text, f"cannot be read ({getattr(error, 'msg', error)})") from error
    except (RecursionError, MemoryError):
        tree = None  # Python's parser has limits of its own, beyond ours
    if tree is None or _is_deep(tree):
        raise _invalid(text, f"nests deeper than {DEEPEST_QUERY} levels; use fewer parentheses")
    reader = _Reader(text, schema)
    try:
        expression = reader.truth(tree)
        ds.InMemoryDataset(schema.empty_table()).to_table(filter=expression)  # finds comparisons of unlike things
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
    """Turns a syntax tree into an expression."""

    def __init__(self, text: str, schema: pa.Schema) -> None:
        self._text, self._schema = text, schema
        self._names = [f.name for f in schema if not pa.types.is_nested(f.type)]
        self.columns: dict[str, None] = {}

    def truth(self, node: ast.expr) -> pc.Expression:
        """An expression that is true or false."""
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
            raise _invalid(self._text, f"names {_quoted(node)[1:-1]}, expected one of {', '.join(self._names)}")
        self.columns[node.id] = None
        return node.id


def _joined(operation: Callable[[Any, Any], Any], parts: list[pc.Expression]) -> pc.Expression:
    """One expression of many, nested no deeper than their logarithm, since Arrow recurses into it on the C++ stack.

    Arrow makes one chain of nested operations of the same kind, whatever their shape. A double negation keeps groups apart.
    """
    while len(parts) > _WIDEST:
        parts = [~~reduce(operation, parts[start : start + _WIDEST]) for start in range(0, len(parts), _WIDEST)]
    return reduce(operation, parts)


def _is_in(value: pc.Expression, constants: list[Any]) -> pc.Expression:
    """Whether a value equals one of some constants; null where the value is.

    ``isin`` alone is false for null, compares unlike types, and tells -0.0 from 0.0. One comparison of each type is added to
    it: with zero where zero is among them.
    """
    parts = []
    for kind in dict.fromkeys(map(type, constants)):
        alike = [constant for constant in constants if type(constant) is kind]
        compared = next((constant for constant in alike if constant == 0), alike[0])
        parts += [value.isin(pa.array(alike)), value == pc.scalar(compared)]
    return _joined(or_, parts)


def _is_deep(tree: ast.expr) -> bool:
    """Whether a syntax tree has more than DEEPEST_QUERY levels."""
    level: list[ast.AST] = [tree]
    for _ in range(DEEPEST_QUERY):
        level = [child for node in level for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
        if not level:
            return False
    return True


def _quoted(words: ast.AST | str) -> str:
    """What was written, as a message repeats it: bounded, on one line."""
    text = repr(words if isinstance(words, str) else ast.unparse(words))
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."


def _invalid(text: str, why: str) -> ConfigError:
    return ConfigError(f"query {_quoted(text)} {why}", "query_invalid")
