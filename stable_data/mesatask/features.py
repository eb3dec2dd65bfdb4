"""Reads and writes sbert_text_features.pkl: text features by uid. The pickle is read without running any code that it names.

The format needs a few names from numpy to describe an array. Stand-ins that store plain values replace them; the array is made
here, from its bytes, after the pickle has been read. No name in the file is imported or called.
"""

import gzip
import io
import math
import pickle
import pickletools
import re
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from stable_data.errors import ConfigError
from stable_data.json_text import quote_value
from stable_data.limits import LIMITS, at_most

FEATURES_FILE = "sbert_text_features.pkl"
_GZIP_MAGIC = b"\x1f\x8b"
_PARSE_ERRORS = (
    pickle.UnpicklingError,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
_TEXTS = ("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8")
_SETS = ("EMPTY_SET", "FROZENSET", "ADDITEMS")  # their items are hashed, as keys are
_PUTS, _GETS = ("PUT", "BINPUT", "LONG_BINPUT"), ("GET", "BINGET", "LONG_BINGET")
_DTYPE = re.compile(r"[<>=|]?(f[248]|U\d{1,9})")  # floats or strings
_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")


def read_text_features(path: Path) -> tuple[tuple[str, ...], npt.NDArray[np.float32]]:
    """Reads the text features of assets, plain or gzip-compressed.

    Args:
        path: A pickle of {"uids": list of N strings, "text_features": array (N, D)}.

    Returns:
        The uids and their features, (N, D) float32.

    Raises:
        ConfigError: The file is missing, too big or not a pickle, refers to anything except numpy arrays (``pickle_refused``), or
            does not have the expected content.
    """
    data = _read_unpacked(path)
    try:
        _check_operations(data, path)
        document = _PlainUnpickler(data, path).load()
    except ConfigError:
        raise
    except _PARSE_ERRORS as error:
        message = f"{path} is not a valid pickle: {quote_value(str(error))}; fetch it again"
        raise ConfigError(message, "features_invalid") from error
    if not isinstance(document, dict) or not {"uids", "text_features"} <= document.keys():
        raise _invalid(path, f"holds a {type(document).__name__}")
    return _check_content(document["uids"], document["text_features"], path)


def write_text_features(path: Path, uids: Sequence[str], features: npt.ArrayLike) -> None:
    """Writes text features in the format of MesaTask-10K.

    Args:
        path: The file.
        uids: N uids.
        features: (N, D); rows are compared by dot product and should have unit length.

    Raises:
        ConfigError: The numbers of uids and rows differ, or a feature is not finite.
    """
    array = np.ascontiguousarray(features, np.float32)
    if array.ndim != 2 or len(array) != len(uids) or not np.isfinite(array).all():
        message = f"{len(uids)} uids and features of shape {array.shape}, expected finite (N, D)"
        raise ConfigError(f"{path} cannot be written: {message}", "features_invalid")
    path.write_bytes(pickle.dumps({"uids": list(uids), "text_features": array}, protocol=4))


class _Described:
    """A pickle's description of a numpy value. It only stores its arguments and state."""

    __slots__ = ("arguments", "state")

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Described):
    """numpy.ndarray: state (version, shape, dtype, is Fortran order, bytes or list)."""

    __slots__ = ()


class _Buffer(_Described):
    """An array of pickle protocol 5: arguments (bytes, dtype, shape, order)."""

    __slots__ = ()


class _Dtype(_Described):
    """numpy.dtype: arguments (type string, …), state (version, byte order, …)."""

    __slots__ = ()


class _Scalar(_Described):
    """A numpy scalar: arguments (dtype, bytes)."""

    __slots__ = ()


class _Bytes(_Described):
    """Bytes in pickle protocol 2: arguments (text, "latin1")."""

    __slots__ = ()


_STAND_INS: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _Bytes,
    **{(module, "_reconstruct"): _Array for module in _MULTIARRAY},
    **{(module, "scalar"): _Scalar for module in _MULTIARRAY},
    **{(module, "_frombuffer"): _Buffer for module in _NUMERIC},
}


class _PlainUnpickler(pickle.Unpickler):
    """Reads plain containers and descriptions of numpy values; refuses everything else."""

    def __init__(self, data: bytes, path: Path) -> None:
        super().__init__(io.BytesIO(data))
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        stand_in = _STAND_INS.get((module, name))
        if stand_in is None:
            self._refuse(f"{module}.{name}")
        return stand_in

    def persistent_load(self, pid: Any) -> Any:
        self._refuse("a persistent id")

    def _refuse(self, what: str) -> NoReturn:
        message = f"{self._path} refers to {quote_value(what)}, expected numpy arrays in plain containers; it was not run, do not trust it"
        raise ConfigError(message, "pickle_refused")


def _read_unpacked(path: Path) -> bytes:
    """Reads the bytes of the pickle, decompressed, up to a limit."""
    if not path.is_file():
        raise ConfigError(f"{path} is missing or not a regular file", "features_missing")
    try:
        with path.open("rb") as file:
            is_gzip = file.read(2) == _GZIP_MAGIC
        with gzip.open(path) if is_gzip else path.open("rb") as file:
            data = file.read(LIMITS.features.max_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ConfigError(f"{path} cannot be read: {error}; fetch it again", "features_invalid") from error
    if len(data) > LIMITS.features.max_bytes:
        raise ConfigError(f"{path} is larger, expected {at_most(LIMITS.features, 'max_bytes', 'bytes')}", "file_too_big")
    return data


def _check_operations(data: bytes, path: Path) -> None:
    """Refuses a pickle that needs much more memory or time than its bytes.

    The check follows the operations with one value for each object: whether it is a text. The keys of a dictionary must be, since Python
    hashes a key each time that it is named: a tuple as often as tuples within it refer to others, which may never end.
    """
    limits = LIMITS.features
    stack, marks, memo = list[bool](), list[int](), dict[int, bool]()
    for number, (operation, argument, _) in enumerate(pickletools.genops(data), 1):
        name, before, after = operation.name, operation.stack_before, operation.stack_after
        if name in _PUTS and argument is not None and argument > limits.max_memo:
            raise _refused(path, f"contains memo index {argument}, expected {at_most(limits, 'max_memo')}")
        if name in _SETS:
            raise _refused(path, "contains a set")
        if number > limits.max_operations:
            raise _refused(
                path, f"contains more operations, expected {at_most(limits, 'max_operations')} and features as one array"
            )
        if name == "MARK":
            marks.append(len(stack))
        elif name in _PUTS or name == "MEMOIZE":
            memo[len(memo) if name == "MEMOIZE" else int(argument or 0)] = stack[-1]
        elif name in _GETS:
            stack.append(memo[int(argument or 0)])
        elif name == "POP" and marks and marks[-1] == len(stack):
            marks.pop()
        else:
            has_mark = pickletools.markobject in before
            mark = marks.pop() if has_mark else len(stack)
            start = mark - before.index(pickletools.markobject) if has_mark else mark - len(before)
            if not all(stack[-2:-1] if name == "SETITEM" else stack[mark::2] if name in ("SETITEMS", "DICT") else ()):
                raise _refused(path, "contains a key that is no text")
            is_text = stack[-1] if name == "DUP" else name in _TEXTS
            stack[start:] = [is_text] * len(after)


def _check_content(uids: Any, described: Any, path: Path) -> tuple[tuple[str, ...], npt.NDArray[np.float32]]:
    """Checks and converts the two values of the document."""
    converter = _Converter(path)
    names = converter.to_plain(uids)
    rows = converter.to_plain(described)
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names):
        raise _invalid(path, f"has a {type(names).__name__} of uids")
    try:
        if len(rows) != len(names):
            raise ValueError(f"{len(rows)} rows for {len(names)} uids")
        if not len(rows):
            return (), np.zeros((0, 0), np.float32)
        features = np.asarray(rows, np.float32) if isinstance(rows, np.ndarray) else _stack_rows(rows)
    except _PARSE_ERRORS as error:
        raise _invalid(path, f"has features that are not a table ({quote_value(str(error))})") from error
    if features.ndim != 2 or not np.isfinite(features).all():
        raise _invalid(path, f"has features of shape {features.shape}, or values that are not finite")
    return tuple(names), features


def _stack_rows(rows: list[Any]) -> npt.NDArray[np.float32]:
    """Makes a table of rows, each a list or an array of numbers; (N, D).

    A pickle may refer to one row many times: each is converted once, and the size of the table is limited.
    """
    num_numbers = sum(len(row) for row in rows)
    if num_numbers > LIMITS.features.max_numbers:
        raise ValueError(f"{num_numbers:,} numbers, expected {at_most(LIMITS.features, 'max_numbers')}")
    converted = dict[int, npt.NDArray[np.float32]]()
    for row in rows:
        if id(row) in converted:
            continue
        if row.ndim != 1 if isinstance(row, np.ndarray) else not all(isinstance(x, int | float) for x in row):
            raise ValueError(f"a row of type {type(row).__name__}, expected a row of numbers")
        converted[id(row)] = np.asarray(row, np.float32)
    return np.stack([converted[id(row)] for row in rows])


def _refused(path: Path, what: str) -> ConfigError:
    message = f"{path} {what}; expected numpy arrays in plain containers; it was not read, do not trust it"
    return ConfigError(message, "pickle_refused")


def _invalid(path: Path, what: str) -> ConfigError:
    expected = 'expected {"uids": N strings, "text_features": finite array (N, D)}'
    return ConfigError(f"{path} {what}, {expected}; fetch it again", "features_invalid")


class _Converter:
    """Converts the described values of a pickle.

    A pickle may refer to the same bytes many times, and each array that is made of them may be a copy. Arrays of an honest file
    have their own bytes: together they are not larger than a file may be.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._num_bytes, self._num_strings = 0, 0  # of all values so far
        self._plain_lists = set[int]()  # ids of lists without described values

    def to_plain(self, value: Any) -> Any:
        """Converts described arrays to lists or arrays, one level of nesting down."""
        if isinstance(value, (list, tuple)):
            if len(value) > LIMITS.features.max_rows:
                raise _invalid(self._path, f"has a list of {len(value):,}, expected {at_most(LIMITS.features, 'max_rows')}")
            return [self._to_array(item) if isinstance(item, _Described) else item for item in value]
        return self._to_array(value) if isinstance(value, _Described) else value

    def _to_array(self, value: _Described) -> Any:
        """Converts a description to the array: floats to an array, strings and objects to a list."""
        try:
            if isinstance(value, _Scalar):
                dtype, data = value.arguments
                return self._from_bytes(data, dtype, (1,), False)[0]
            if isinstance(value, _Buffer):
                data, dtype, shape, order = value.arguments
                return self._from_bytes(data, dtype, shape, order == "F")
            _, shape, dtype, is_fortran, data = value.state
            if isinstance(data, list):
                if len(data) != _size(shape) or not self._is_plain(data):
                    raise ValueError(f"{len(data)} plain items for shape {shape}")
                return data
            return self._from_bytes(data, dtype, shape, is_fortran)
        except _PARSE_ERRORS as error:
            raise _invalid(self._path, f"describes an invalid array ({quote_value(str(error))})") from error

    def _is_plain(self, items: list[Any]) -> bool:
        """Whether a list has no described values; each list is looked at once."""
        if id(items) not in self._plain_lists and not any(isinstance(item, _Described) for item in items):
            self._plain_lists.add(id(items))
        return id(items) in self._plain_lists

    def _from_bytes(self, data: bytes | _Bytes, dtype: _Dtype, shape: tuple[int, ...], is_fortran: bool) -> Any:
        """Makes an array of floats, or a list of strings, from its bytes."""
        raw = data.arguments[0] if isinstance(data, _Bytes) else data
        name, size = dtype.arguments[0], _size(shape)
        if not isinstance(name, str):
            raise ValueError(f"a dtype that is {type(name).__name__}, expected its name")
        found = _DTYPE.fullmatch(name)
        if found is None:
            raise ValueError(f"dtype {quote_value(name)}, expected floats or strings")
        kind = found[1]
        is_big = bool(dtype.state) and dtype.state[1] == ">"  # the byte order is part of the state
        self._num_bytes += len(raw)
        if self._num_bytes > LIMITS.features.max_bytes:
            raise ValueError(f"more bytes of arrays, expected {at_most(LIMITS.features, 'max_bytes')}")
        self._num_strings += size if kind[0] == "U" else 0
        if self._num_strings > LIMITS.features.max_rows:
            raise ValueError(f"{self._num_strings:,} strings, expected {at_most(LIMITS.features, 'max_rows')}")
        content: bytes = raw.encode("latin-1") if isinstance(raw, str) else raw
        order = ">" if is_big else "<"
        array = np.frombuffer(content, np.dtype(order + kind))
        if kind[0] == "U" and (np.frombuffer(content, f"{order}u4") > sys.maxunicode).any():
            raise ValueError("a character that Unicode does not have, expected text")
        array = array.reshape(shape, order="F" if is_fortran else "C")
        return array.tolist() if kind[0] == "U" else array


def _size(shape: Any) -> int:
    """The number of items of an array of a shape."""
    if not isinstance(shape, tuple) or len(shape) > 2 or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise ValueError("an invalid shape, expected one or two lengths")
    if max(shape, default=0) > LIMITS.features.max_numbers:  # the product of lengths with millions of digits takes minutes
        raise ValueError(f"a longer shape, expected {at_most(LIMITS.features, 'max_numbers', 'numbers')}")
    return math.prod(shape)
