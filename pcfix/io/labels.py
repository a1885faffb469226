"""Which camera a name of an image means."""

from __future__ import annotations

from collections import defaultdict
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from pcfix.model import IntArray


class Matched(NamedTuple):
    """What names were found to mean.

    row : array of int, shape (n,)
        Row of the labels of each name, -1 where there is none or it could be several.
    ambiguous : tuple of str
        Names that could be several labels, or share one with another name.
    """

    row: IntArray
    ambiguous: tuple[str, ...]


def match_labels(names: Sequence[str], labels: Sequence[str]) -> Matched:
    """Find each name among labels: whole, without its folder, without its extension.

    Parameters
    ----------
    names : sequence of str, length n
        All different.
    labels : sequence of str

    Returns
    -------
    Matched
    """
    row = np.full(len(names), -1, np.int64)
    unclear: set[int] = set()
    for key in KEYS:
        here, there = _rows_by(key, names), _rows_by(key, labels)
        for word, mine in here.items():
            found = there.get(word, [])
            if len(mine) == 1 == len(found) and row[mine[0]] < 0:
                row[mine[0]] = found[0]
            elif found:
                unclear.update(mine)
    return Matched(row, tuple(names[i] for i in sorted(unclear) if row[i] < 0))


def is_named(name: str, labels: Iterable[str]) -> bool:
    """Whether one of the labels can be what a name means."""
    return _stem(name) in {_stem(label) for label in labels}


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
