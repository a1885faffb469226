"""Counted that grow chunk by chunk, in one process or in several."""

from __future__ import annotations

from typing import Any, ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

Counted: TypeAlias = dict[str, npt.NDArray[Any]]


class Sums:
    """The base of what is added up chunk by chunk; others' counts can be added to it.

    A class names its attributes: `added` are numbers, arrays, dictionaries of numbers, or lists of
    arrays, which are joined; of `least` and `most` the smallest or the largest counts. One that is
    `Sums` itself goes by its own names, and one that is None stays so.
    """

    added: ClassVar[tuple[str, ...]] = ()
    least: ClassVar[tuple[str, ...]] = ()
    most: ClassVar[tuple[str, ...]] = ()

    def counted(self) -> Counted:
        """Return what was counted so far."""
        found: Counted = {}
        for name in (*self.added, *self.least, *self.most):
            value = getattr(self, name)
            if isinstance(value, Sums):
                found.update({f"{name}.{key}": one for key, one in value.counted().items()})
            elif isinstance(value, list):
                found.update({name: np.concatenate(value)} if value else {})
            elif value is not None:
                found[name] = np.array([*value.values()] if isinstance(value, dict) else value)
        return found

    def add_counted(self, counted: Counted) -> None:
        """Count what another one did, which began as this one."""
        joins = ((self.added, np.add), (self.least, np.minimum), (self.most, np.maximum))
        for name, join in ((name, join) for names, join in joins for name in names):
            own, head = getattr(self, name), f"{name}."
            if isinstance(own, Sums):
                inner = {key: one for key, one in counted.items() if key.startswith(head)}
                own.add_counted({key.removeprefix(head): one for key, one in inner.items()})
            elif isinstance(own, dict):
                both = join([*own.values()], counted[name]).tolist()
                own.update(zip(own, both, strict=True))
            elif isinstance(own, list):
                own.extend([counted[name]] if name in counted else [])
            elif own is not None and name in counted:
                both = join(own, counted[name])
                setattr(self, name, both if isinstance(own, np.ndarray) else both.item())
