"""Damage: bytes that flip, fall out or come twice, and words that no writer meant, put where a number or a name stood."""

from __future__ import annotations

import re
from random import Random

from fuzz.cases import Files

# What a number may be replaced by: too large for int, float, int64 or a date, no number, or digits that int() refuses.
NUMBERS = [
    b"0", b"-1", b"1e308", b"-1e308", b"1e999999999", b"1e-999999999", b"nan", b"inf", b"-Infinity", b"NaN", b"1_000",
    b"9" * 5000, b"9" * 400, b"1" + b"0" * 30, b"9223372036854775807", b"9223372036854775808", b"18446744073709551616",
    b"4294967295", b"2147483648", b"-9223372036854775809", b"0x10", b"1.5", b"1e400", b"1e30", b"1e-320", b"1e7",
    "²".encode(), "٣".encode(), b"", b"true", b"null", b"1979-05-27", b"12:61:99",
]  # fmt: skip
# What may stand anywhere.
WORDS = [
    b"\xff", b"\x00", b"\xc3\x28", b"\n", b"\n\n\n", b"\r", b"\r\n", b" ", b",", b"\t", b'"', b"'", b"=", b":", b"#",
    b"[" * 3000, b"]", b"{", b"}", b'{"a":' * 3000, b"a." * 3000 + b"a = 1\n", b"a" * 400, b"../../../../x", b"/",
    b"\xef\xbb\xbf", b"\xff\xfe", "\u2028\u0085\x0b".encode(), b"<a>" * 2000, b"<!DOCTYPE html>", b"<!ENTITY a 'b'>",
    b"e" * 140_000, b"\xf0\x9f\x98\x80", b"\x1b[31m",
]  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")
_EDGES = [
    0,
    1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    2**63 - 1,
    2**64 - 1,
    10**9,
    2**40,
]
# Behind it a binary file has numbers only.
_HEAD = 4096


def mutated(files: Files, rng: Random, others: list[Files]) -> Files:
    """`files` with one of them damaged in one to four places; `others` lend bytes."""
    name = rng.choice(sorted(files))
    data = files[name]
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_KINDS)(data, rng)
    if rng.random() < 0.05:
        lender = rng.choice(others)
        lent = lender[rng.choice(sorted(lender))]
        cut = rng.randrange(len(data) + 1)
        data = data[:cut] + lent[rng.randrange(len(lent) + 1) :]
    if rng.random() < 0.01 and len(files) > 1:
        return {other: content for other, content in files.items() if other != name}
    return {**files, name: data}


def _flip(data: bytes, rng: Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        if out:
            out[_place(out, rng)] ^= 1 << rng.randrange(8)
    return bytes(out)


def _overwrite(data: bytes, rng: Random) -> bytes:
    at, new = _place(data, rng), rng.randbytes(rng.choice((1, 2, 4, 8)))
    return data[:at] + new + data[at + len(new) :]


def _edge(data: bytes, rng: Random) -> bytes:
    """An integer at its limits, where one may have stood."""
    size = rng.choice((1, 2, 4, 8))
    at, value = _place(data, rng), rng.choice(_EDGES) % (1 << 8 * size)
    return data[:at] + value.to_bytes(size, rng.choice(("little", "big"))) + data[at + size :]


def _truncate(data: bytes, rng: Random) -> bytes:
    return data[: _place(data, rng)]


def _drop(data: bytes, rng: Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + rng.choice((1, 2, 8, 64, 512)) :]


def _repeat(data: bytes, rng: Random) -> bytes:
    at, size = _place(data, rng), rng.choice((1, 8, 64, 512))
    return data[:at] + data[at : at + size] * rng.choice((2, 2, 3, 20)) + data[at + size :]


def _word(data: bytes, rng: Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.choice(WORDS) + data[at + rng.choice((0, 0, 1, 4)) :]


def _number(data: bytes, rng: Random) -> bytes:
    found = [m.span() for m in _NUMBER.finditer(data[:_HEAD])]
    if not found:
        return _edge(data, rng)
    begin, end = rng.choice(found)
    return data[:begin] + rng.choice(NUMBERS) + data[end:]


def _line(data: bytes, rng: Random) -> bytes:
    """A line that is empty, missing, twice, or elsewhere."""
    lines = data[:_HEAD].split(b"\n")
    k = rng.randrange(len(lines))
    what = rng.randrange(4)
    if what == 0:
        lines[k] = b""
    elif what == 1:
        del lines[k]
    elif what == 2:
        lines.insert(k, lines[k])
    else:
        lines.insert(rng.randrange(len(lines)), lines.pop(k))
    return b"\n".join(lines) + data[_HEAD:]


_KINDS = (
    _flip,
    _flip,
    _overwrite,
    _edge,
    _edge,
    _truncate,
    _drop,
    _repeat,
    _word,
    _word,
    _number,
    _number,
    _number,
    _line,
)


def _place(data: bytes | bytearray, rng: Random) -> int:
    """Anywhere; half of the time near the beginning, where headers are, or near the end, where indices are."""
    size = len(data)
    if not size:
        return 0
    which = rng.random()
    if which < 0.4:
        return rng.randrange(min(size, 512))
    return size - 1 - rng.randrange(min(size, 512)) if which < 0.5 else rng.randrange(size)
