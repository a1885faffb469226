"""Match the names of images with the labels of cameras."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import PurePosixPath

import numpy as np

from pcfix.model import IntArray


def match_labels(
    names: Sequence[str], labels: Sequence[str], *, one_to_one: bool = True
) -> tuple[IntArray, tuple[str, ...]]:
    """Find each name among labels: the complete name, else without its folder or its extension.

    With `one_to_one` no two names may have the same label.

    Returns
    -------
    row : array, shape (names,)
        Of the labels; -1 where there is none or it could be several.
    ambiguous : tuple of str
        Names that could be several labels, or share one with another name.
    """
    row = np.full(len(names), -1, np.int64)
    unclear: set[int] = set()
    for key in KEYS:
        here, there = _rows_by(key, names), _rows_by(key, labels)
        for word, rows in here.items():
            found = there.get(word, [])
            left = [i for i in rows if row[i] < 0]
            if len(found) == 1 and (len(rows) == 1 or not one_to_one):
                row[left] = found[0]
            elif found:
                unclear.update(rows)
    return row, tuple(names[i] for i in sorted(unclear) if row[i] < 0)


def unnamed(names: Iterable[str], labels: Iterable[str]) -> tuple[str, ...]:
    """Return the names, each once, that match none of the labels."""
    stems = {_stem(label) for label in labels}
    return tuple(name for name in dict.fromkeys(names) if _stem(name) not in stems)


def _rows_by(key: Callable[[str], str], names: Sequence[str]) -> dict[str, list[int]]:
    rows = defaultdict(list)
    for i, name in enumerate(names):
        rows[key(name)].append(i)
    return rows


def _file_name(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name


def _stem(name: str) -> str:
    return PurePosixPath(_file_name(name)).stem.lower()


KEYS: tuple[Callable[[str], str], ...] = (str, _file_name, _stem)
