"""Statistics that are accumulated with ``+`` over chunks and files, and the results of commands."""

from __future__ import annotations

import operator
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any, Self

import numpy as np

from pcfix.errors import plain

LEAST = {"join": np.minimum}
MOST = {"join": np.maximum}
SAME = {"join": lambda one, other: one}
"""Metadata of fields that are joined by the minimum, by the maximum, or by taking either value."""


class Sums:
    """The base of dataclasses that are added field by field.

    Numbers, arrays and sums are added, and tuples are joined. None stands for a value that is not
    known yet. Fields with the metadata `LEAST`, `MOST` or `SAME` are joined in another way.
    """

    def __add__(self, other: Self) -> Self:
        """Return the statistics of all points of both."""
        joined = {}
        for one in fields(self):  # type: ignore[arg-type]
            mine, theirs = getattr(self, one.name), getattr(other, one.name)
            if mine is not None and theirs is not None:
                mine = one.metadata.get("join", operator.add)(mine, theirs)
            joined[one.name] = theirs if mine is None else mine
        return replace(self, **joined)  # type: ignore[type-var]


def nice_step(least: float) -> float:
    """Return the smallest number of the form 1, 2 or 5 times 10^k that is at least `least`."""
    if not least > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(f * power for f in (1, 2, 5, 10) if f * power >= least * (1.0 - 1e-9)))


class Figures(SimpleNamespace):
    """The results of a command by name, for its printed summary and for ``--summary``."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(plain(self))
