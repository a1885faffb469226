"""XML of camera files, read so that no entity is expanded and nothing outside is fetched."""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, Any
from xml.etree.ElementTree import ParseError

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
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

    Raises
    ------
    InputError
        If it is cut off or not well-formed, or declares entities.
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
