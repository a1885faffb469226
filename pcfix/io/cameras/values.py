"""Values out of XML and JSON that may be anything; each message names file and place."""

from __future__ import annotations

import json
from typing import IO, TYPE_CHECKING, Any
from xml.etree.ElementTree import ParseError

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.model import FloatArray


def read_xml(path: Path, stream: IO[bytes] | None = None) -> Element:
    """Return the root of a document.

    Parameters
    ----------
    path : Path
        The file; only for messages when `stream` is given.
    stream : binary file, optional
        Read this instead, for documents inside an archive.
    """
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import parse

    try:
        root: Element = parse(stream if stream is not None else path, forbid_dtd=False).getroot()
    except DefusedXmlException as error:
        raise InputError(
            f"{path}: the XML declares entities, which no camera file needs; it is not read."
        ) from error
    except (ParseError, LookupError, ValueError) as error:
        raise InputError(
            f"{path}: the XML is damaged or cut off ({error}); export it again."
        ) from error
    return root


def number(path: Path, where: str, text: str | None) -> float:
    """Return the number in a text; `where` is the image and element, for the message."""
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: {where}: '{(text or '').strip()}' is not a number.")
    return value


def numbers(path: Path, where: str, text: str | None, count: int) -> FloatArray:
    """Return `count` numbers separated by white space or commas."""
    words: list[Any] = (text or "").replace(",", " ").split()
    if len(words) != count:
        raise InputError(f"{path}: {where}: has {len(words)} numbers instead of {count}.")
    return np.array([number(path, where, word) for word in words])


def load_json(path: Path) -> Any:
    """Return what a JSON file holds."""
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: the JSON is damaged or cut off ({error}); copy it again from the project."
        ) from error


def mapping(path: Path, where: str, value: Any) -> dict[str, Any]:
    """Return a value that is a JSON object."""
    if not isinstance(value, dict):
        raise InputError(f"{path}: {where} is not an object with names but {_shown(value)}.")
    return value


def json_number(path: Path, where: str, value: Any) -> float:
    """Return a finite number."""
    return float(vector(path, where, [value], 1)[0])


def vector(path: Path, where: str, value: Any, count: int) -> FloatArray:
    """Return `count` finite numbers."""
    return np.asarray(rows(path, where, [value], count)[0])


def rows(path: Path, where: str, values: Collection[Any], count: int) -> FloatArray:
    """Return rows of `count` finite numbers each, shape (len(values), count)."""
    try:
        found = np.array(list(values), dtype=np.float64).reshape(len(values), -1)
    except (TypeError, ValueError, OverflowError):
        found = np.empty((len(values), 0))
    if len(values) and (found.shape[1] != count or not np.isfinite(found).all()):
        shown = next((v for v in values if not _is_row(v, count)), values)
        raise InputError(f"{path}: {where}: {_shown(shown)} is not {count} finite number(s).")
    return found.reshape(len(values), count)


def _is_row(value: Any, count: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == count
        and all(isinstance(v, int | float) and abs(v) < np.inf for v in value)
    )


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
