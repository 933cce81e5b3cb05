"""Untrusted text: every oddity is a ValueError, and no other module parses JSON or TOML."""

from __future__ import annotations

import json
import re
import tomllib
from io import BytesIO
from pathlib import Path

import pytest

from lslam.core import untrusted
from lslam.core.errors import InputError
from lslam.core.untrusted import JsonItems, is_file, parse_json, parse_toml, whole_number

PACKAGE = Path(__file__).resolve().parents[1] / "lslam"
DIGITS = "9" * 5000


@pytest.mark.parametrize(
    "text",
    [
        "[" * 5000,
        "[" * 200 + "]" * 200,
        '{"a":' * 3000,
        DIGITS,
        f"[-{DIGITS}]",
        "9223372036854775808",
        b"\xff",
        "",
        "{",
    ],
)
def test_json_that_cannot_be_used_is_a_value_error(text: str | bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_json(text)


@pytest.mark.parametrize(
    "text",
    [
        f"a = {DIGITS}",
        "a = 9223372036854775808",
        "a = " + "[" * 5000,
        "a = " + "[" * 200 + "]" * 200,
        "a." * 300 + "a = 1",
        "a =",
    ],
)
def test_toml_that_cannot_be_used_is_said_to_be_none(text: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError):
        parse_toml(text)


def test_what_is_good_stays_as_it_is() -> None:
    assert parse_json('{"a": [1, -9223372036854775808, 2.5, null]}') == {"a": [1, -(2**63), 2.5, None]}
    assert parse_toml("a = [1, {b = 9223372036854775807}]") == {"a": [1, {"b": 2**63 - 1}]}
    assert [whole_number(t) for t in ("0", "12", "²", "", "1.0", DIGITS)] == [0, 12, None, None, None, None]
    assert not is_file("a" * 400)


DOCUMENTS = [
    '{"elements": []}',
    '{}',
    ' \n{ "version" : 0.6, "elements" :\t[ {"id": 1, "tags": {"name": "M\u00fcnchen \U0001f600"}} , 2.5e-3, null, "a\\"]," ] }\n',
    '{"elements": [{"lat": 1.25}, {"lat": 12}], "remark": "late", "more": [[1, 2], {"x": []}], "number": 123456789}',
    '{"type": "FeatureCollection", "features": [{"a": [1, 2]}, {}], "elements": "none"}',
]  # fmt: skip


@pytest.mark.parametrize("block", [1, 2, 3, 7, 1 << 16])
@pytest.mark.parametrize("text", DOCUMENTS)
def test_items_one_by_one_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch, text: str, block: int) -> None:
    monkeypatch.setattr(untrusted, "_BLOCK", block)
    tree = parse_json(text)
    has_list = isinstance(tree.get("elements"), list)
    for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-32-le"):
        items = JsonItems(BytesIO(text.encode(encoding)), "elements")
        assert list(items) == (tree["elements"] if has_list else [])
        assert items.rest == {key: value for key, value in tree.items() if not (has_list and key == "elements")}
        assert items.has_list is has_list


@pytest.mark.parametrize("text", DOCUMENTS)
def test_what_is_cut_short_is_never_taken_for_whole(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr(untrusted, "_BLOCK", 5)
    whole = text.rstrip().encode()
    for length in range(len(whole)):
        with pytest.raises((json.JSONDecodeError, UnicodeDecodeError)):
            list(JsonItems(BytesIO(whole[:length]), "elements"))


@pytest.mark.parametrize(
    "text",
    [
        '{"elements": [1,\n 2 x]}', '{"elements": [1, 2]} x', '{"elements": [1,]}', '{"a" 1}', '{"a": tru}', '{1: 2}',
        '{"a": 1.}',
        '{"elements": [' + '"long", ' * 50 + '\n\n 1 2]}', "[1, 2", "", "x", '{"a": 1,}', '{"elements": [1 }',
    ],
)  # fmt: skip
def test_what_is_broken_is_said_with_its_place(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr(untrusted, "_BLOCK", 8)
    with pytest.raises(json.JSONDecodeError) as known:
        parse_json(text)
    with pytest.raises(json.JSONDecodeError) as found:
        list(JsonItems(BytesIO(text.encode()), "elements"))
    place = re.compile(r"line (\d+) column \d+ \(char \d+\)")
    (one,), (other,) = place.findall(str(known.value)), place.findall(str(found.value))
    assert one == other


@pytest.mark.parametrize(
    "text",
    [
        '{"elements": [' + "[" * 5000,
        '{"elements": [' + "[" * 200 + "]" * 200 + "]}",
        f'{{"elements": [{DIGITS}]}}',
        f'{{"a": {DIGITS}}}',
        '{"elements": [], "elements": []}',
    ],
)
def test_what_no_machine_holds_is_refused_item_by_item_too(text: str) -> None:
    with pytest.raises(ValueError, match=r"deep|64 bits|twice"):
        list(JsonItems(BytesIO(text.encode()), "elements"))


def test_json_and_toml_are_parsed_here_only() -> None:
    found = [
        p
        for p in PACKAGE.rglob("*.py")
        if re.search(r"\b(json|tomllib)\.(loads?|JSONDecoder)\(", p.read_text(encoding="utf-8"))
    ]
    assert found == [PACKAGE / "core/untrusted.py"]


def test_a_sentence_quotes_no_flood_and_nothing_a_terminal_obeys() -> None:
    said = str(InputError(f"x.txt: {'[' * 5000!r} and \x1b[31m"))
    assert len(said) < 400
    assert said.startswith("x.txt: '[[[")
    assert said.endswith(r"and \x1b[31m")
