"""Whether what a LAS or LAZ file counts is what it holds."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lazrs

from pcfix.errors import InputError

_VARIABLE_CHUNKS = 2**32 - 1
_WITHOUT_CHUNKS = 1
"""The compressor of files that are one stream (LASzip record)."""
_ITEMS = 32
"""Where the record says how many things are packed; each has a type, its bytes and a version."""
_LAYERED = 3
"""The compressor that packs the dimensions of a chunk apart, from point format 6 on."""
_LAYERS = 9
"""So many for each point of format 6; colours, infrared and waveforms have one each."""
_MOST_EMPTY_BYTES = 2**28
"""Of a chunk that is larger than the cloud: memory is taken for all of its points."""


def check_count(path: Path, header: Any, vlrs: Any, stated: int) -> None:
    """Refuse a header that states fewer points than its file holds.

    Bytes of zeros behind the last point are padding.

    Raises
    ------
    InputError
        With both counts.
    """
    if header.are_points_compressed:
        held, words = _least_in_chunks(path, header, vlrs), "at least "
    else:
        held, words = _held(path, header, stated), ""
    if held > stated:
        raise InputError(
            f"{path}: its header counts {stated:,} points, the file holds"
            f" {words}{held:,}: those beyond would be lost; mend the header, or export the cloud"
            " again."
        )


def _held(path: Path, header: Any, stated: int) -> int:
    """Return how many records lie between the header and what comes behind the points."""
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


def _least_in_chunks(path: Path, header: Any, vlrs: Any) -> int:
    """Return how many points the full chunks of a LAZ file hold, and the last; 0 if not known.

    Of the last chunk only a layered one says how many it has: else it is taken for one.
    """
    table = _table(path, header, vlrs)
    if table is None or table.points == _VARIABLE_CHUNKS or not table.chunks:
        return 0
    last = 1
    if _is_layered(table):
        with path.open("rb") as stream:
            sizes = _chunk_sizes(stream, table)
            stream.seek(table.start + sum(sizes[:-1]) + header.point_format.size)
            (stated,) = _unpacked("<I", stream.read(4)) or (1,)
        last = stated if sizes and stated <= table.points else 1
    return (table.chunks - 1) * table.points + last


class _Table(NamedTuple):
    """The chunks of a LAZ file: points of each, how many there are, bytes of them all.

    And where the first begins, and the record that says how they are packed.
    """

    points: int
    chunks: int
    size: int
    start: int
    packing: bytes


def check_chunks(path: Path, header: Any, vlrs: Any) -> None:
    """Refuse a LAZ file that counts chunks which it cannot hold.

    Its decompressor would take memory for as many as are stated, and end the process.

    Raises
    ------
    ValueError
        With what is wrong.
    """
    table = _table(path, header, vlrs)
    if table is None:
        return
    (count,) = struct.unpack_from("<H", table.packing, _ITEMS)
    items = table.packing[_ITEMS + 2 : _ITEMS + 2 + 6 * count]
    packed = sum(size for _, size, _ in struct.iter_unpack("<HHH", items))
    if packed != header.point_format.size:
        raise ValueError(
            f"its points have {header.point_format.size} bytes, those that are packed {packed}"
        )
    if table.points == 0:
        raise ValueError("its chunks have no points")
    chunk_bytes = 0 if table.points == _VARIABLE_CHUNKS else table.points * packed
    if table.points > header.point_count and chunk_bytes > _MOST_EMPTY_BYTES:
        raise ValueError(
            f"it states chunks of {table.points:,} points, and has {header.point_count:,}"
        )
    if table.chunks * header.point_format.size > max(table.size, 0):
        raise ValueError(f"it states {table.chunks:,} chunks of points in {table.size:,} bytes")
    if table.chunks * table.points < header.point_count:
        raise ValueError(
            f"it states {header.point_count:,} points in {table.chunks:,} chunks of"
            f" {table.points:,}"
        )
    if _is_layered(table) and header.point_count:
        _check_layers(path, header.point_format, table)


def _check_layers(path: Path, point_format: Any, table: _Table) -> None:
    """Refuse chunks that are larger than all of them, and layers larger than their chunk."""
    with path.open("rb") as stream:
        sizes = _chunk_sizes(stream, table)
        if sum(sizes) > table.size:
            raise ValueError(f"it states chunks of {sum(sizes):,} bytes in {table.size:,}")
        start = table.start
        for size in sizes:
            stream.seek(start)
            check_chunk(stream.read(head_size(point_format)), size, point_format)
            start += size


def _is_layered(table: _Table) -> bool:
    return bool(struct.unpack_from("<H", table.packing)[0] == _LAYERED)


def _chunk_sizes(stream: BinaryIO, table: _Table) -> list[int]:
    """Return the bytes of each chunk; none where the table is damaged: who reads points says it."""
    stream.seek(table.start - 8)
    try:
        chunks = lazrs.read_chunk_table(stream, lazrs.LazVlr(table.packing))
    except lazrs.LazrsError:
        return []
    return [size for _, size in chunks]


def head_size(point_format: Any) -> int:
    """Return how many bytes of a layered chunk come before its layers."""
    return int(point_format.size + 4 + 4 * _layers(point_format))


def check_chunk(head: bytes, size: int, point_format: Any) -> None:
    """Refuse layers larger than their chunk, as memory is taken for them before they are read.

    A layered chunk begins with its first point; then come how many points it has, and the bytes of
    each layer.

    Raises
    ------
    ValueError
        With both.
    """
    layers = _unpacked(f"<{_layers(point_format)}I", head[point_format.size + 4 :]) or ()
    if sum(layers) > size:
        raise ValueError(f"it states layers of {sum(layers):,} bytes in a chunk of {size:,}")


def _layers(point_format: Any) -> int:
    names = set(point_format.dimension_names)
    more = sum(one in names for one in ("red", "nir", "wavepacket_index"))
    return int(_LAYERS + more + point_format.num_extra_bytes)


def _table(path: Path, header: Any, vlrs: Any) -> _Table | None:
    """Return what the table of chunks says; None where the file has none."""
    vlr = next((v for v in vlrs if v.user_id == "laszip encoded"), None)
    if vlr is None or not header.are_points_compressed:
        return None
    if struct.unpack_from("<H", vlr.record_data)[0] == _WITHOUT_CHUNKS:
        return None
    packing = bytes(vlr.record_data)
    (points,) = struct.unpack_from("<I", packing, 12)
    start, size = header.offset_to_point_data, path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(start)
        (place,) = _unpacked("<q", stream.read(8)) or (0,)
        if place == -1:  # of writers that cannot go back
            stream.seek(max(size - 8, 0))
            (place,) = _unpacked("<q", stream.read(8)) or (0,)
        if not start + 8 <= place <= size - 8:
            if header.point_count:  # its reader would take gigabytes before it says so
                raise ValueError(f"its table of chunks would begin at byte {place:,} of {size:,}")
            return None
        stream.seek(place + 4)
        (count,) = _unpacked("<I", stream.read(4)) or (0,)
        return _Table(points, count, place - start - 8, start + 8, packing)


def _unpacked(layout: str, data: bytes) -> tuple[int, ...] | None:
    return struct.unpack(layout, data) if len(data) == struct.calcsize(layout) else None
