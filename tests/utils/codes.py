"""Refusals and warnings by their codes, which programs may rely on; sentences may change."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from pcfix.errors import PcfixError, PcfixWarning


@contextmanager
def refused(code: str, kind: type[PcfixError] = PcfixError, **values: Any) -> Iterator[Any]:
    """Expect an error of this code, with these of its values; gives what pytest caught."""
    with pytest.raises(kind) as caught:
        yield caught
    check(caught.value, code, values)


@contextmanager
def warned(code: str, **values: Any) -> Iterator[Any]:
    """Expect a warning of this code, with these of its values; others may come beside it."""
    with pytest.warns(PcfixWarning) as caught:
        yield caught
    found = [one.message for one in caught if isinstance(one.message, PcfixWarning)]
    assert code in [one.code for one in found], found
    check(next(one for one in found if one.code == code), code, values)


def check(found: PcfixError | PcfixWarning, code: str, values: dict[str, Any]) -> None:
    """Compare the code and some values; paths are compared as text."""
    assert found.code == code, f"{found.code}: {found}"
    for name, value in values.items():
        assert plain(found.values[name]) == plain(value), (name, found.values)


def plain(value: Any) -> Any:
    return value if isinstance(value, int | float | tuple | list | None) else str(value)
