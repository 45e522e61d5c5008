"""Mutates a file: changes, repeats, moves or removes bytes, lines, numbers and words."""

from __future__ import annotations

import random
import re

NUMBERS = (
    "0",
    "-1",
    "1e308",
    "-1e308",
    "1e400",
    "1e-320",
    ".inf",
    ".nan",
    "NaN",
    "Infinity",
    "9" * 399,
    "9" * 5000,
    "2147483648",
    "9e18",
    "-0.0",
    "1e30",
    "0x7f",
    "1_0",
    "null",
    "true",
    "''",
    "[]",
    "{}",
)
TEXTS = (
    "\x00",
    "\r",
    "\r\n",
    "\n",
    '"',
    "'",
    "[",
    "{",
    "}",
    "]",
    ":",
    ",",
    "&a ",
    "*a",
    "<<: *a",
    "!!int ",
    "%",
    "|",
    ">",
    "- ",
    "\t",
    "\ufeff",
    "é",
    "\u2028",
    "\\ud800",
    "x" * 300,
    "x" * 140_000,
    "../",
    "/",
    "\x1b[31m",
)
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{2,}")


def mutated(data: bytes, chance: random.Random) -> bytes:
    """The content after one to four changes."""
    for _ in range(chance.choice((1, 1, 1, 2, 2, 4))):
        data = chance.choice(CHANGES)(data, chance)
    return data


def _flip(data: bytes, chance: random.Random) -> bytes:
    if not data:
        return b"\xff"
    at = chance.randrange(len(data))
    return data[:at] + bytes([chance.randrange(256)]) + data[at + 1 :]


def _cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def _remove(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + data[at + chance.choice((1, 4, 40, 400)) :]


def _insert(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + chance.choice(TEXTS).encode() + data[at:]


def _number(data: bytes, chance: random.Random) -> bytes:
    return _replaced(_NUMBER, data, chance, chance.choice(NUMBERS).encode())


def _word(data: bytes, chance: random.Random) -> bytes:
    words = [found[0] for found in _WORD.finditer(data[:20_000])] or [b"x"]
    return _replaced(_WORD, data, chance, chance.choice(words))


def _replaced(pattern: re.Pattern[bytes], data: bytes, chance: random.Random, new: bytes) -> bytes:
    found = list(pattern.finditer(data[:20_000]))
    if not found:
        return data + new
    one = chance.choice(found)
    return data[: one.start()] + new + data[one.end() :]


def _lines(data: bytes, chance: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return b"\n"
    first, second = chance.randrange(len(lines)), chance.randrange(len(lines))
    match chance.randrange(3):
        case 0:
            lines[first], lines[second] = lines[second], lines[first]
        case 1:
            del lines[first]
        case _:
            lines.insert(first, lines[second])
    return b"".join(lines)


def _ends(data: bytes, chance: random.Random) -> bytes:
    return data.replace(b"\n", chance.choice((b"\r", b"\r\n", b" ", b"\n\n")))


CHANGES = (_flip, _cut, _remove, _insert, _number, _number, _word, _lines, _ends)
