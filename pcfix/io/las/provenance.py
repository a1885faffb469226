"""The VLR that says what pcfix did, and what the file was before."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from laspy.vlrs.vlr import VLR

from pcfix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

USER_ID = "pcfix"
SETTINGS_RECORD = 1
DESCRIPTION = "pcfix settings (JSON)"
CLEANING_RECORD = 2
CLEANING_DESCRIPTION = "pcfix cleaning (JSON)"
LABELLING_RECORD = 3
LABELLING_DESCRIPTION = "pcfix labelling (JSON)"
BEFORE = (
    "version",
    "point_format",
    "identity",
    "global_encoding",
    "offsets",
    "steps",
    "added_wkt",
    "undescribed",
)
"""What the VLR says of the file before the correction."""


def is_ours(vlr: VLR) -> bool:
    """Whether a VLR is the one of `settings_vlr`."""
    return bool(vlr.user_id == USER_ID and vlr.record_id == SETTINGS_RECORD)


def settings_vlr(content: dict[str, Any]) -> VLR:
    """Return the VLR that holds the content as JSON."""
    return _json_vlr(SETTINGS_RECORD, DESCRIPTION, content)


def cleaning_vlr(content: dict[str, Any]) -> VLR:
    """Return the VLR that says how a file was cleaned, as JSON; one for each cleaning."""
    return _json_vlr(CLEANING_RECORD, CLEANING_DESCRIPTION, content)


def labelling_vlr(content: dict[str, Any]) -> VLR:
    """Return the VLR that says how a file was labelled, as JSON; one for each labelling."""
    return _json_vlr(LABELLING_RECORD, LABELLING_DESCRIPTION, content)


def _json_vlr(record: int, description: str, content: dict[str, Any]) -> VLR:
    text = json.dumps(content, ensure_ascii=True, separators=(",", ":"))
    return VLR(USER_ID, record, description, text.encode())


def read_settings(vlrs: Iterable[VLR], path: Path) -> dict[str, Any]:
    """Return the content of the VLR.

    Raises
    ------
    InputError
        If there is none, or it is damaged.
    """
    ours = next((vlr for vlr in vlrs if is_ours(vlr)), None)
    if ours is None:
        raise InputError(f"{path}: was not corrected by pcfix; there is nothing to undo.")
    try:
        content: dict[str, Any] = json.loads(ours.record_data)
        _ = content["settings"]["dimensions"], [content["before"][key] for key in BEFORE]
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{path}: pcfix's own VLR is damaged ({error}); use the original cloud."
        ) from error
    return content
