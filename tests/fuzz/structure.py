"""Inputs with the shape of good ones and content of no writer: trees and tables by hypothesis, which knows odd values."""

from __future__ import annotations

import json
import re
import tomllib
from typing import Any

import tomli_w
from fuzz.cases import Files
from fuzz.mutate import NUMBERS
from hypothesis import strategies as st

_NAMES = ["type", "id", "nodes", "coordinates", "geometry", "lat", "lon", "base", "x" * 400, "", "é", "a.b", "../x"]
_LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([2**63, -(2**63) - 1, 2**64, 10**25, 10**400, 0, -1])
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["nan", "1e999999999", "²", "x" * 400, "\ud800", "\x00", "../../x", "way/1", "Polygon"])
)
VALUES = st.recursive(
    _LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(_NAMES), inner, max_size=3),
    max_leaves=8,
)
_EDITS = st.lists(
    st.tuples(st.integers(0, 10**6), st.sampled_from(["set", "drop", "add", "twice"]), VALUES), min_size=1, max_size=3
)
_CELLS = (
    st.sampled_from([n.decode() for n in NUMBERS])
    | st.text(max_size=5)
    | st.floats().map(repr)
    | st.integers().map(str)
)
_CELL = re.compile(r"[^\s,;:=]+")


def trees(files: Files, name: str) -> st.SearchStrategy[Files]:
    """`files` with the tree in `name`, JSON or TOML, changed in one to three nodes."""
    return _EDITS.map(lambda edits: {**files, name: edited(files[name], name.endswith(".toml"), edits)})


def tables(files: Files, name: str) -> st.SearchStrategy[Files]:
    """`files` with some words of the lines of `name` changed; of a binary file those of its head."""
    cells = st.lists(st.tuples(st.integers(0, 10**6), _CELLS), min_size=1, max_size=4)
    return cells.map(lambda changes: {**files, name: _reworded(files[name], changes)})


def edited(data: bytes, is_toml: bool, edits: list[tuple[int, str, Any]]) -> bytes:
    """The tree in `data` with its nodes numbered through, each edit at one of them."""
    tree = [tomllib.loads(data.decode()) if is_toml else json.loads(data)]
    for number, what, value in edits:
        nodes = _nodes(tree)
        holder, key = nodes[number % len(nodes)]
        if what == "drop":
            if holder is not tree:
                del holder[key]
        elif what == "add" and isinstance(holder[key], dict):
            holder[key][_NAMES[number % len(_NAMES)]] = value
        elif what == "twice" and isinstance(holder, list) and holder is not tree:
            holder.append(holder[key])
        else:
            holder[key] = value
    if not is_toml:
        return json.dumps(tree[0]).encode(errors="replace")
    try:
        text: str = tomli_w.dumps(
            _without_none(tree[0]) if isinstance(tree[0], dict) else {"a": _without_none(tree[0])}
        )
    except (TypeError, ValueError):
        return data
    return text.encode(errors="surrogatepass")


def _nodes(tree: list[Any]) -> list[tuple[Any, Any]]:
    """Each node as (what holds it, its key there)."""
    found: list[tuple[Any, Any]] = []
    waiting: list[Any] = [tree]
    while waiting:
        here = waiting.pop()
        items = here.items() if isinstance(here, dict) else enumerate(here)
        for key, value in items:
            found.append((here, key))
            if isinstance(value, (dict, list)):
                waiting.append(value)
    return found


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return [_without_none(v) for v in value if v is not None] if isinstance(value, list) else value


def _reworded(data: bytes, changes: list[tuple[int, str]]) -> bytes:
    head, rest = data[:4096].decode("latin-1"), data[4096:]
    for number, word in changes:
        spans = [m.span() for m in _CELL.finditer(head)]
        if spans:
            begin, end = spans[number % len(spans)]
            head = head[:begin] + word.encode("utf-8", "replace").decode("latin-1") + head[end:]
    return head.encode("latin-1") + rest
