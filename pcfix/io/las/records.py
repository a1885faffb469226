"""Variable length records with their bytes as they are in the file.

laspy has classes of its own for many of them, which lose some bytes when they write; it cuts
names that fill their field; and it believes any number of records that a damaged header states.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING

from laspy.vlrs.vlr import VLR
from laspy.vlrs.vlrlist import VLRList

if TYPE_CHECKING:
    from typing import BinaryIO

WAVEFORM_PACKETS = ("LASF_Spec", 65535)
_VLR, _EVLR = "<2x16sHH32s", "<2x16sHQ32s"
_INTERNAL_WAVEFORMS = 2
"""Bit of the global encoding (LAS 1.4 R15, table 4)."""


class Record(VLR):  # type: ignore[misc]  # laspy is untyped
    """A record that remembers the bytes before its data."""

    def __init__(self, head: bytes, data: bytes) -> None:
        layout = _VLR if len(head) == struct.calcsize(_VLR) else _EVLR
        user_id, record_id, _, description = struct.unpack(layout, head)
        name = user_id.split(b"\0")[0].decode("latin-1")
        super().__init__(name, record_id, description.rstrip(b"\0"), data)
        self.head = head
        self.record_data: bytes

    def to_bytes(self) -> bytes:
        """Return the whole record."""
        return self.head + self.record_data

    def replaced(self, data: bytes) -> Record:
        """Return a VLR with other data and the same names."""
        return Record(self.head[:20] + struct.pack("<H", len(data)) + self.head[22:], data)


class RecordList(VLRList):  # type: ignore[misc]
    """VLRs for a laspy header; a `Record` is written as it was read."""

    def write_to(
        self, stream: BinaryIO, as_extended: bool = False, encoding_errors: str = "strict"
    ) -> int:
        """Write all records and return the number of bytes."""
        written = 0
        for vlr in self:
            if isinstance(vlr, Record):
                written += stream.write(vlr.to_bytes())
            else:
                written += VLRList([vlr]).write_to(stream, as_extended, encoding_errors)
        return written


def read_records(stream: BinaryIO) -> tuple[list[Record], list[Record]]:
    """Return the VLRs and the EVLRs of a LAS or LAZ file.

    The waveform packets inside a LAS 1.3 file count as an EVLR.

    Raises
    ------
    ValueError, struct.error
        If the file does not hold what its header says.
    """
    head = stream.read(375)
    if head[:4] != b"LASF":
        raise ValueError("it does not begin with LASF")
    start, points_start, count = struct.unpack_from("<HII", head, 94)
    vlrs = _read(stream, start, count, _VLR, points_start)
    encoding, minor = head[6], head[25]
    if minor >= 4:
        start, count = struct.unpack_from("<QI", head, 235)
    elif minor == 3 and encoding & _INTERNAL_WAVEFORMS:
        start, count = *struct.unpack_from("<Q", head, 227), 1
    else:
        count = 0
    return vlrs, _read(stream, start, count, _EVLR, 2**64)


def _read(stream: BinaryIO, start: int, count: int, layout: str, end: int) -> list[Record]:
    """Read records that lie one behind another, up to a place that they must not pass."""
    end = min(end, os.fstat(stream.fileno()).st_size)
    records: list[Record] = []
    size = struct.calcsize(layout)
    for _ in range(count):
        if start + size > end:
            raise ValueError(f"its header states {count:,} records, it has {len(records):,}")
        stream.seek(start)
        head = stream.read(size)
        _, record_id, length, _ = struct.unpack(layout, head)
        start += size + length
        if start > end:
            raise ValueError(f"record {record_id} is cut short")
        records.append(Record(head, stream.read(length)))
    return records


def append_evlrs(stream: BinaryIO, records: list[Record], minor_version: int) -> None:
    """Append EVLRs to a file that is otherwise whole, and tell its header."""
    start = stream.seek(0, os.SEEK_END)
    if records and minor_version >= 4:
        stream.seek(235)
        stream.write(struct.pack("<QI", start, len(records)))
    for record in records:
        if (record.user_id, record.record_id) == WAVEFORM_PACKETS:
            stream.seek(227)
            stream.write(struct.pack("<Q", start))
        stream.seek(start)
        start += stream.write(record.to_bytes())
