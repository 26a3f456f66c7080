"""Values over a pipe: a JSON header, then the raw bytes of arrays.  Never pickle.

A frame is  length of the header (uint32) | length of the arrays (uint64) | header | arrays.  The header is
{"kind": ..., "value": tree, "arrays": [[dtype, shape], ...]}; in the tree a list is ["l", ...], a tuple ["t", ...], a
dict ["d", [key, value], ...], an array ["a", number], a float that JSON has not ["f", "nan"], a function of the kit
["k", name, {numbers}]; texts, numbers, true, false and null stand for themselves.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

LENGTHS = struct.Struct("<IQ")
MOST_HEADER, MOST_ARRAYS, MOST_NODES, MOST_DEPTH, MOST_DIMENSIONS = 2**20, 2**26, 100_000, 12, 8
DTYPES = ("<f8", "<f4", "<i8", "<i4", "|b1", "<c16", "<c8")


class ProtocolError(ValueError):
    """A value that cannot be sent, or a frame that is none."""


@dataclass(frozen=True)
class KitFunction:
    """A function that only the sandbox has: `getattr(kit, name)(**numbers)`."""

    name: str
    numbers: dict[str, Any] = field(default_factory=dict)


def kit_function(name: str, **numbers: Any) -> KitFunction:
    """A callback to hand to student code."""
    return KitFunction(name, numbers)


# Writing


def encode(kind: str, value: Any = None) -> bytes:
    """One frame.  Raises ProtocolError for what is no plain value."""
    arrays: list[np.ndarray[Any, Any]] = []
    count = [0]
    tree = _tree(value, arrays, count, 0)
    body = b"".join(array.tobytes() for array in arrays)
    if len(body) > MOST_ARRAYS:
        raise ProtocolError(f"arrays must have at most {MOST_ARRAYS} bytes together; got {len(body)}")
    shapes = [[array.dtype.str, list(array.shape)] for array in arrays]
    header = json.dumps({"kind": kind, "value": tree, "arrays": shapes}, allow_nan=False).encode()
    if len(header) > MOST_HEADER:
        raise ProtocolError(f"a value must be told in at most {MOST_HEADER} bytes beside its arrays; got {len(header)}")
    return LENGTHS.pack(len(header), len(body)) + header + body


def _tree(value: Any, arrays: list[Any], count: list[int], depth: int) -> Any:
    count[0] += 1
    if depth > MOST_DEPTH or count[0] > MOST_NODES:
        raise ProtocolError("a value must be small: lists in lists at most 12 deep, 100000 entries in all")
    kind = type(value)
    if value is None or kind in (bool, str):
        return value
    if kind is int:
        if not -(2**63) <= value < 2**63:
            raise ProtocolError("a whole number must fit in 64 bits")
        return value
    if kind is float:
        return value if math.isfinite(value) else ["f", repr(value)]
    if kind in (list, tuple):
        return ["l" if kind is list else "t", *(_tree(entry, arrays, count, depth + 1) for entry in value)]
    if kind is dict:
        return ["d", *([_key(key), _tree(entry, arrays, count, depth + 1)] for key, entry in value.items())]
    if kind is KitFunction:
        return ["k", value.name, _tree(value.numbers, arrays, count, depth + 1)]
    return _array_tree(value, arrays)


def _key(key: Any) -> str:
    if type(key) is not str:
        raise ProtocolError(f"keys of a dict must be texts; got one of type {type(key).__name__}")
    return key


def _array_tree(value: Any, arrays: list[Any]) -> Any:
    if type(value).__module__.partition(".")[0] == "scipy" and hasattr(value, "toarray"):
        if math.prod(value.shape) * 8 > MOST_ARRAYS:
            raise ProtocolError(f"a sparse matrix must be at most {MOST_ARRAYS} bytes when dense; got {value.shape}")
        value = value.toarray()
    if not isinstance(value, np.ndarray | np.generic):
        raise ProtocolError(f"values must be numbers, texts, arrays, or lists of them; got a {type(value).__name__}")
    if value.nbytes > MOST_ARRAYS:
        raise ProtocolError(f"arrays must have at most {MOST_ARRAYS} bytes together; got {value.nbytes}")
    array = np.array(value, copy=True, subok=False, order="C")
    dtype = array.dtype.newbyteorder("<")
    if dtype.kind in "iu" and dtype.str not in DTYPES:
        dtype = np.dtype("<i8")
    if dtype.str not in DTYPES or array.ndim > MOST_DIMENSIONS:
        raise ProtocolError(f"arrays must hold floats, whole or complex numbers; got {array.dtype}, {array.ndim}-D")
    arrays.append(array.astype(dtype))
    return ["a", len(arrays) - 1]


# Reading


def read(take: Callable[[int], bytes]) -> tuple[str, Any]:
    """(kind, value) of the next frame; take(n) gives exactly n bytes.  Raises ProtocolError for anything malformed."""
    header, body = read_raw(take)
    return decode(header, body)


def read_raw(take: Callable[[int], bytes]) -> tuple[bytes, bytes]:
    """Header and arrays of the next frame, not yet looked into."""
    lengths = LENGTHS.unpack(take(LENGTHS.size))
    if lengths[0] > MOST_HEADER or lengths[1] > MOST_ARRAYS:
        raise ProtocolError(f"a frame must have at most {MOST_HEADER} and {MOST_ARRAYS} bytes; got {lengths}")
    both = take(sum(lengths))
    return both[: lengths[0]], both[lengths[0] :]


def kind_of(header: bytes) -> str:
    """The kind of a frame, for one that hands it on unread."""
    return str(json.loads(header)["kind"])


def decode(header: bytes, body: bytes) -> tuple[str, Any]:
    """(kind, value) from the two parts of a frame."""
    try:
        data = json.loads(header)
        kind, tree, shapes = data["kind"], data["value"], data["arrays"]
        arrays = _arrays(shapes, body)
        count = [0]
        if type(kind) is not str:
            raise ProtocolError("kind must be a text")
        return kind, _value(tree, arrays, count, 0)
    except ProtocolError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, RecursionError, OverflowError, AttributeError) as error:
        raise ProtocolError(f"not a frame: {type(error).__name__}") from None


def _arrays(shapes: Any, body: bytes) -> list[Any]:
    if type(shapes) is not list or len(shapes) > MOST_NODES:
        raise ProtocolError("arrays must be a list")
    found, start = [], 0
    for dtype, shape in shapes:
        if dtype not in DTYPES or len(shape) > MOST_DIMENSIONS or not all(type(n) is int and n >= 0 for n in shape):
            raise ProtocolError("an array must have a known type and a shape")
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if start + size > len(body):
            raise ProtocolError("an array is longer than its bytes")
        array = np.frombuffer(body, dtype, math.prod(shape), start).reshape(shape).copy()
        if dtype == "|b1" and not np.isin(array.view(np.uint8), (0, 1)).all():
            raise ProtocolError("truth values must be 0 or 1")
        found.append(array)
        start += size
    if start != len(body):
        raise ProtocolError("more bytes than arrays")
    return found


def _value(tree: Any, arrays: list[Any], count: list[int], depth: int) -> Any:
    count[0] += 1
    if depth > MOST_DEPTH + 1 or count[0] > MOST_NODES:
        raise ProtocolError("a value must be small")
    if tree is None or type(tree) in (bool, int, float, str):
        return tree
    if type(tree) is not list or not tree:
        raise ProtocolError("a tree must be of the stated kinds")
    tag, *rest = tree
    if tag in ("l", "t"):
        entries = [_value(entry, arrays, count, depth + 1) for entry in rest]
        return entries if tag == "l" else tuple(entries)
    if tag == "d":
        return {_key(key): _value(entry, arrays, count, depth + 1) for key, entry in rest}
    if tag == "a" and type(rest[0]) is int and rest[0] >= 0:
        return arrays[rest[0]]
    if tag == "f" and rest[0] in ("nan", "inf", "-inf"):
        return float(rest[0])
    if tag == "k" and type(rest[0]) is str:
        return KitFunction(rest[0], _value(rest[1], arrays, count, depth + 1))
    raise ProtocolError("a tree must be of the stated kinds")
