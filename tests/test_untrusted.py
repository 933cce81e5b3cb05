"""Text of strangers: every oddity is a ValueError, and nobody parses JSON or TOML elsewhere."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from lslam.errors import InputError
from lslam.untrusted import decimal_number, is_file, parse_json, parse_toml, whole_number

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
    for text in ("1e999999999", "-1e999999999", "nan", "inf", "9223372036854775808", "x"):
        with pytest.raises(ValueError, match="no number below"):
            decimal_number(text)


def test_json_and_toml_are_parsed_here_only() -> None:
    found = [
        p for p in PACKAGE.rglob("*.py") if re.search(r"\b(json|tomllib)\.loads?\(", p.read_text(encoding="utf-8"))
    ]
    assert found == [PACKAGE / "untrusted.py"]


def test_a_sentence_quotes_no_flood_and_nothing_a_terminal_obeys() -> None:
    said = str(InputError(f"x.txt: {'[' * 5000!r} and \x1b[31m"))
    assert len(said) < 400
    assert said.startswith("x.txt: '[[[")
    assert said.endswith(r"and \x1b[31m")
