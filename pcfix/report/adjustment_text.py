"""Words and numbers of an adjustment that several reports share."""

from __future__ import annotations

from collections.abc import Sequence

from pcfix.adjust.result import Plain

WHERE = (("land", "on land"), ("water", "under water"))

_LENS = {"f": "focal length", "cx": "principal x", "cy": "principal y"}


def all_notes(d: Plain) -> list[str]:
    """Return the messages of all warnings, each once."""
    doubts = d["precision"]["doubts"] if d["precision"] is not None else []
    notes = [one["message"] for one in [*d["notes"], *doubts]]
    return list(dict.fromkeys(note[:1].upper() + note[1:] for note in notes))


def fixed(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number with a fixed number of digits; a dash if it is unknown."""
    if value is None:
        return "-"
    # a zero has no minus sign
    return f"{value if abs(value) >= 0.5 * 10.0**-digits else 0.0:{sign}.{digits}f}"


def listed(values: Sequence[float | None] | None, digits: int = 3, sign: str = "") -> str:
    """Return numbers separated by commas; a dash if they are unknown."""
    return "-" if values is None else ", ".join(fixed(value, digits, sign) for value in values)


def short(value: float, sigma: float | None, sign: str = "") -> str:
    """Return a number with the digits that its standard error justifies, two at least."""
    if sigma is None or not sigma > 0.0:
        return f"{value:{sign}.6g}"
    digits = 2
    while digits < 9 and sigma < 2.0 * 10.0**-digits:
        digits += 1
    return f"{value:{sign}.{digits}f}"


def lens_label(row: Plain) -> str:
    """Return what a surveyor calls a lens parameter."""
    return str(_LENS.get(row["name"], row["name"]))


def has_many_sensors(d: Plain) -> bool:
    """Return whether parameters of several sensors were free."""
    return len({row["sensor"] for row in d["lens"]}) > 1
