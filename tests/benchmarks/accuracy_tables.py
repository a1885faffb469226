"""Plain and Markdown tables of rows that are dicts; a column is (key, heading, format)."""

from __future__ import annotations

from typing import Any, TypeAlias

Column: TypeAlias = tuple[str, str, str]


def table(rows: list[dict[str, Any]], columns: list[Column], *, markdown: bool) -> str:
    """Return a table; words to the left, numbers to the right, a dash for None."""
    cells = [[_cell(row.get(key), form) for key, _, form in columns] for row in rows]
    heads = [head for _, head, _ in columns]
    words = [form == "" for _, _, form in columns]
    width = [max(len(line[i]) for line in [heads, *cells]) for i in range(len(columns))]

    def line(texts: list[str]) -> str:
        padded = [
            text.ljust(w) if word else text.rjust(w)
            for text, w, word in zip(texts, width, words, strict=True)
        ]
        return "| " + " | ".join(padded) + " |" if markdown else "  ".join(padded).rstrip()

    rule = ["-" * w if word else "-" * (w - 1) + ":" for w, word in zip(width, words, strict=True)]
    return "\n".join([line(heads), *([line(rule)] if markdown else []), *map(line, cells)])


def _cell(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)
