"""Whether a LAS or LAZ file holds more points than its header counts."""

from __future__ import annotations

import struct

from pcfix.errors import InputError
from pcfix.io.las.source import LasSource

_VARIABLE_CHUNKS = 2**32 - 1


def check_count(source: LasSource) -> None:
    """Refuse a header that counts fewer points than its file holds.

    Bytes of zeros behind the last point are padding.

    Raises
    ------
    InputError
        With both counts.
    """
    header, stated = source.header, source.held
    if header.are_points_compressed:
        held, words = _least_in_chunks(source), "at least "
    else:
        held, words = _held(source), ""
    if held > stated:
        raise InputError(
            f"{source.path}: its header counts {stated:,} points, the file holds {words}{held:,}:"
            " those beyond would be lost; mend the header, or export the cloud again."
        )


def _held(source: LasSource) -> int:
    """Return how many records lie between the header and what comes behind the points."""
    header, path, stated = source.header, source.path, source.held
    size, start = header.point_format.size, header.offset_to_point_data
    behind = [path.stat().st_size]
    for name in ("start_of_first_evlr", "start_of_waveform_data_packet_record"):
        place = getattr(header, name, None) or 0
        behind += [place] if place > start else []
    held = (min(behind) - start) // size
    if held > stated:
        with path.open("rb") as stream:
            stream.seek(start + stated * size)
            if not any(stream.read(size)):
                return stated
    return int(held)


def _least_in_chunks(source: LasSource) -> int:
    """Return how many points the full chunks of a LAZ file hold, and one more; 0 if not known."""
    vlr = next((v for v in source.vlrs if v.user_id == "laszip encoded"), None)
    if vlr is None:
        return 0
    (chunk,) = struct.unpack_from("<I", vlr.record_data, 12)
    with source.path.open("rb") as stream:
        stream.seek(source.header.offset_to_point_data)
        (table,) = struct.unpack("<q", stream.read(8))
        if chunk == _VARIABLE_CHUNKS or not 0 < table <= source.path.stat().st_size - 8:
            return 0
        stream.seek(table + 4)
        (chunks,) = struct.unpack("<I", stream.read(4))
    return int((chunks - 1) * chunk + 1) if chunks else 0
