"""Damage to the bytes of a file, each kind as it happens: to disks, in transfers, by hand."""

import re
import struct
from collections.abc import Callable
from random import Random
from typing import TypeAlias

Damage: TypeAlias = Callable[[bytes, Random], bytes]

NUMBERS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-1", "0", "-0.0", "", "1", "1.5"),
    *("2147483648", "4294967296", "99999999999999999999", "9" * 5000, "0x10", "1_000", "1,5"),
    *("\u0663", "null", "true", "abc", "[]", "{}", '"7"', "1e400", "1e16", "180.1"),
)
"""What stands where a number should."""
_NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][\w.:-]*")
_PIECE = re.compile(rb"<[^<>]*>|\"[^\"]*\"\s*:?|[\[{][^\[\]{}]*[\]}]")
_WORDS_BYTES = (
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, -1.0)),
    *(struct.pack("<Q", value) for value in (0, 1, 2**31, 2**32, 2**62, 2**63, 2**64 - 1)),
    *(struct.pack("<I", value) for value in (0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1)),
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), 3e38)),
)


def _place(data: bytes, random: Random) -> int:
    return random.randrange(len(data) + 1)


def _range(data: bytes, random: Random) -> tuple[int, int]:
    start = _place(data, random)
    return start, min(len(data), start + random.choice((1, 2, 4, 8, 33, 1000)))


def bit(data: bytes, random: Random) -> bytes:
    changed = bytearray(data or b"\0")
    changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def byte(data: bytes, random: Random) -> bytes:
    changed = bytearray(data or b"\0")
    changed[random.randrange(len(changed))] = random.randrange(256)
    return bytes(changed)


def cut(data: bytes, random: Random) -> bytes:
    return data[: _place(data, random)]


def gone(data: bytes, random: Random) -> bytes:
    start, stop = _range(data, random)
    return data[:start] + data[stop:]


def twice(data: bytes, random: Random) -> bytes:
    start, stop = _range(data, random)
    return data[:stop] + data[start:]


def zeros(data: bytes, random: Random) -> bytes:
    start, stop = _range(data, random)
    return data[:start] + bytes(stop - start) + data[stop:]


def binary_number(data: bytes, random: Random) -> bytes:
    at, put = _place(data, random), random.choice(_WORDS_BYTES)
    return data[:at] + put + data[at + len(put) :]


def _lines(change: Callable[[list[bytes], int, Random], None]) -> Damage:
    def damage(data: bytes, random: Random) -> bytes:
        lines = data.splitlines(keepends=True) or [b""]
        change(lines, random.randrange(len(lines)), random)
        return b"".join(lines)

    return damage


def _line_gone(lines: list[bytes], at: int, random: Random) -> None:
    del lines[at]


def _line_twice(lines: list[bytes], at: int, random: Random) -> None:
    lines.insert(at, lines[at])


def _lines_swapped(lines: list[bytes], at: int, random: Random) -> None:
    other = random.randrange(len(lines))
    lines[at], lines[other] = lines[other], lines[at]


def _columns_swapped(lines: list[bytes], at: int, random: Random) -> None:
    by = next((one for one in (b",", b";", b"\t") if one in lines[at]), b" ")
    count = lines[at].count(by) + 1
    one, other = random.randrange(count), random.randrange(count)
    for i in [at] if random.random() < 0.5 else range(len(lines)):
        fields = lines[i].rstrip(b"\r\n").split(by)
        if len(fields) == count:
            fields[one], fields[other] = fields[other], fields[one]
            lines[i] = by.join(fields) + b"\n"


def _instead(pattern: re.Pattern[bytes], of: Callable[[bytes, Random], bytes]) -> Damage:
    """Put something else where a pattern is found, at one place."""

    def damage(data: bytes, random: Random) -> bytes:
        found = list(pattern.finditer(data))
        if not found:
            return byte(data, random)
        start, stop = random.choice(found).span()
        return data[:start] + of(data[start:stop], random) + data[stop:]

    return damage


def other_encoding(data: bytes, random: Random) -> bytes:
    text, name = data.decode("latin-1"), random.choice(("utf-16", "utf-8-sig", "cp037", "utf-32"))
    return text.encode(name, errors="replace")


def no_ascii(data: bytes, random: Random) -> bytes:
    at = _place(data, random)
    return (
        data[:at]
        + random.choice((b"\xe9", b"\xff\xfe", b"\0", b"\x1b[2J", b"\xe2\x80\xa8"))
        + data[at:]
    )


def nested(data: bytes, random: Random) -> bytes:
    at, many = _place(data, random), random.choice((50, 3000))
    return data[:at] + random.choice((b"[", b'{"a":', b"<a>", b'"', b"\n", b"(")) * many + data[at:]


PLAIN: tuple[Damage, ...] = (bit, byte, cut, gone, twice, zeros, binary_number)
TEXT: tuple[Damage, ...] = (
    *(_lines(one) for one in (_line_gone, _line_twice, _lines_swapped, _columns_swapped)),
    *[_instead(_NUMBER, lambda _, random: random.choice(NUMBERS).encode())] * 5,
    _instead(_WORD, lambda word, random: random.choice((b"", word[:-1], word + b"2", b"nan"))),
    _instead(_PIECE, lambda piece, random: random.choice((b"", piece * 2, b"null", piece[:-1]))),
    *(other_encoding, no_ascii, nested),
)


def mutated(data: bytes, random: Random) -> bytes:
    """Return damaged bytes: in one place mostly, in up to four sometimes."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        is_text = b"\0" not in data[:200] and random.random() < 0.8
        data = random.choice(TEXT if is_text else PLAIN)(data, random)
    return data
