"""Damage to the bytes of a file, each kind as it happens: to disks, in transfers, by hand."""

import re
import struct
from random import Random

# What stands where a number should.
NUMBERS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-1", "0", "-0.0", "", "1", "1.5"),
    *("2147483648", "4294967296", "99999999999999999999", "9" * 5000, "0x10", "1_000", "1,5"),
    *("\u0663", "null", "true", "abc", "[]", "{}", '"7"', "1e400", "1e16", "180.1"),
)
BINARY = (
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, -1.0)),
    *(struct.pack("<Q", value) for value in (0, 1, 2**31, 2**32, 2**62, 2**63, 2**64 - 1)),
    *(struct.pack("<I", value) for value in (0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1)),
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), 3e38)),
)
STRANGE = (b"\xe9", b"\xff\xfe", b"\0", b"\x1b[2J", b"\xe2\x80\xa8")
ENCODINGS = ("utf-16", "utf-8-sig", "cp037", "utf-32")
OPENING = (b"[", b'{"a":', b"<a>", b'"', b"\n", b"(")
NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][\w.:-]*")
PIECE = re.compile(rb"<[^<>]*>|\"[^\"]*\"\s*:?|[\[{][^\[\]{}]*[\]}]")


def put(data: bytes, place: int, layout: str, *values: float) -> bytes:
    """Put numbers in a place."""
    changed = bytearray(data)
    struct.pack_into(layout, changed, place, *values)
    return bytes(changed)


def bytes_changed(data: bytes, random: Random) -> bytes:
    """Change, cut, repeat or overwrite some bytes."""
    start = random.randrange(len(data) + 1)
    stop = min(len(data), start + random.choice((1, 2, 4, 8, 33, 1000)))
    one, put = data[start : start + 1] or b"\0", random.choice(BINARY)
    return random.choice((
        data[:start] + bytes([one[0] ^ 1 << random.randrange(8)]) + data[start + 1 :],
        data[:start] + bytes([random.randrange(256)]) + data[start + 1 :],
        data[:start],
        data[:start] + data[stop:],
        data[:stop] + data[start:],
        data[:start] + bytes(stop - start) + data[stop:],
        data[:start] + put + data[start + len(put) :],
    ))  # fmt: skip


def lines_changed(data: bytes, random: Random) -> bytes:
    """Remove, repeat or exchange lines, or exchange columns in one of them or in all."""
    lines = data.splitlines(keepends=True) or [b""]
    at, other = random.randrange(len(lines)), random.randrange(len(lines))
    kind = random.choice(("gone", "twice", "swapped", "columns"))
    if kind == "gone":
        del lines[at]
    elif kind == "twice":
        lines.insert(at, lines[at])
    elif kind == "swapped":
        lines[at], lines[other] = lines[other], lines[at]
    else:
        by = next((one for one in (b",", b";", b"\t") if one in lines[at]), b" ")
        count = lines[at].count(by) + 1
        one, two = random.randrange(count), random.randrange(count)
        for i in [at] if random.random() < 0.5 else range(len(lines)):
            fields = lines[i].rstrip(b"\r\n").split(by)
            if len(fields) == count:
                fields[one], fields[two] = fields[two], fields[one]
                lines[i] = by.join(fields) + b"\n"
    return b"".join(lines)


def part_changed(data: bytes, random: Random) -> bytes:
    """Put something else in place of a number, mostly, or a word, or a piece in brackets."""
    found = list(random.choice([NUMBER] * 5 + [WORD, PIECE]).finditer(data))
    if not found:
        return bytes_changed(data, random)
    match = random.choice(found)
    instead = random.choice((b"", match[0] * 2, match[0][:-1], match[0] + b"2", b"nan", b"null"))
    if NUMBER.fullmatch(match[0]):
        instead = random.choice(NUMBERS).encode()
    return data[: match.start()] + instead + data[match.end() :]


def text_changed(data: bytes, random: Random) -> bytes:
    """Use another encoding, or put strange bytes or many opening brackets somewhere."""
    if random.random() < 0.3:
        return data.decode("latin-1").encode(random.choice(ENCODINGS), errors="replace")
    at = random.randrange(len(data) + 1)
    many = random.choice(OPENING) * random.choice((50, 3000))
    return data[:at] + random.choice((random.choice(STRANGE), many)) + data[at:]


def mutated(data: bytes, random: Random) -> bytes:
    """Return damaged bytes: in one place mostly, in up to four sometimes."""
    kinds = [lines_changed] * 4 + [part_changed] * 7 + [text_changed] * 3
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        is_text = b"\0" not in data[:200] and random.random() < 0.8
        data = (random.choice(kinds) if is_text else bytes_changed)(data, random)
    return data
