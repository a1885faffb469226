"""Statistics that are added up with ``+``, over chunks and files, and the results of commands."""

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
"""Metadata of fields of which the smallest or largest value counts, or that are the same."""


class Sums:
    """The base of dataclasses whose fields are added up one by one.

    Numbers, arrays and sums are added, tuples joined; None is what is not known yet. Fields with
    the metadata `LEAST`, `MOST` or `SAME` are joined otherwise.
    """

    def __add__(self, other: Self) -> Self:
        """Return the statistics of the points of both."""
        joined = {}
        for one in fields(self):  # type: ignore[arg-type]
            mine, theirs = getattr(self, one.name), getattr(other, one.name)
            if mine is not None and theirs is not None:
                mine = one.metadata.get("join", operator.add)(mine, theirs)
            joined[one.name] = theirs if mine is None else mine
        return replace(self, **joined)  # type: ignore[type-var]


def nice_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not below a number."""
    if not least > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(f * power for f in (1, 2, 5, 10) if f * power >= least * (1.0 - 1e-9)))


class Figures(SimpleNamespace):
    """The results of a command by name, as its text and the JSON file of its summary have them."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(plain(self))
