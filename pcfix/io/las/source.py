"""Read a LAS or LAZ file chunk by chunk, and keep what laspy would rewrite.

Variable length records stay with their bytes as they are in the file. laspy has classes of its own
for many of them, which lose some bytes when they write; it cuts names that fill their field; and it
believes any number of records that a damaged header states.
"""

import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.vlr import VLR
from laspy.vlrs.vlrlist import VLRList

from pcfix.errors import bad_file
from pcfix.io.crs import METRES, shortened
from pcfix.io.files import check_input
from pcfix.model import FloatArray
from pcfix.options.declare import File
from pcfix.running import current

if TYPE_CHECKING:
    from pyproj import CRS


_VLR, _EVLR = "<2x16sHH32s", "<2x16sHQ32s"
IDENTITY_PLACE = 26  # where the header names system, software and date (LAS 1.4 R15, table 3)
# What the LAS libraries raise.
_DAMAGED = (
    *(laspy.LaspyException, lazrs.LazrsError, struct.error),
    *(ValueError, IndexError, ArithmeticError, OSError),
)
# GeoTIFF codes of units (EPSG), and the least of the codes that only a user knows.
_UNITS, _OWN_CODE = {9001: "metre", 9002: "foot", 9003: "US survey foot"}, 32767

MOST_SCALE_M = 1000.0  # largest step of coordinates that a header may state
CHUNK_POINTS = 400_000  # points that are worked on at a time, which bounds the memory


class Record(VLR):  # type: ignore[misc]  # laspy is untyped
    """A record that remembers the bytes before its data."""

    def __init__(self, head: bytes, data: bytes) -> None:
        layout = _VLR if len(head) == struct.calcsize(_VLR) else _EVLR
        user_id, record_id, _, description = struct.unpack(layout, head)
        name = user_id.split(b"\0")[0].decode("latin-1")
        super().__init__(name, record_id, description.rstrip(b"\0"), data)
        self.head = head
        self.record_data: bytes


class RecordList(VLRList):  # type: ignore[misc]
    """VLRs for a laspy header; a `Record` is written unchanged."""

    def write_to(
        self, stream: BinaryIO, as_extended: bool = False, encoding_errors: str = "strict"
    ) -> int:
        """Write all records and return the number of bytes."""
        written = 0
        for vlr in self:
            if isinstance(vlr, Record):
                written += stream.write(vlr.head + vlr.record_data)
            else:
                written += VLRList([vlr]).write_to(stream, as_extended, encoding_errors)
        return written


def read_records(stream: BinaryIO) -> tuple[list[Record], list[Record]]:
    """Return the VLRs and the EVLRs of a LAS or LAZ file, see `las_errors` for what it raises.

    The waveform packets inside a LAS 1.3 file count as an EVLR.
    """
    stream.seek(0)
    head = stream.read(375)
    if head[:4] != b"LASF":
        raise ValueError("it does not begin with LASF")
    if len(head) > 25 and not (head[24] == 1 and head[25] <= 4):
        raise ValueError(f"its version is {head[24]}.{head[25]}, and there are 1.0 to 1.4")
    start, points_start, count = struct.unpack_from("<HII", head, 94)
    if points_start > stream.seek(0, os.SEEK_END):  # laspy would read up to there
        raise ValueError("its points would begin after the end of the file")
    vlrs = _read(stream, start, count, _VLR, points_start)
    encoding, minor = head[6], head[25]
    if minor >= 4:
        start, count = struct.unpack_from("<QI", head, 235)
    elif minor == 3 and encoding & 2:  # waveforms inside the file (LAS 1.4 R15, table 4)
        start, count = *struct.unpack_from("<Q", head, 227), 1
    else:
        count = 0
    return vlrs, _read(stream, start, count, _EVLR, 2**64)


def _read(stream: BinaryIO, start: int, count: int, layout: str, end: int) -> list[Record]:
    """Read records that lie one behind another, up to a place that they must not pass."""
    end = min(end, stream.seek(0, os.SEEK_END))
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


def append_evlrs(stream: BinaryIO, records: Sequence[Record], minor_version: int) -> None:
    """Append EVLRs to a file that is otherwise complete, and state them in its header."""
    start = stream.seek(0, os.SEEK_END)
    if records and minor_version >= 4:
        stream.seek(235)
        stream.write(struct.pack("<QI", start, len(records)))
    for record in records:
        if (record.user_id, record.record_id) == ("LASF_Spec", 65535):  # waveform packets
            stream.seek(227)
            stream.write(struct.pack("<Q", start))
        stream.seek(start)
        start += stream.write(record.head + record.record_data)


@contextmanager
def las_errors(path: Path) -> Iterator[None]:
    """Turn whatever the LAS libraries raise into one sentence about the file."""
    try:
        yield
    except BaseException as error:
        # lazrs panics, too, if the points are damaged; that exception cannot be imported
        if not isinstance(error, _DAMAGED) and type(error).__name__ != "PanicException":
            raise
        reason = str(error).strip().rstrip(".") or type(error).__name__
        sentence = f"is damaged, or is not a LAS or LAZ file ({reason}). Export or copy it again."
        if "PointWise" in reason:
            sentence = "has the point-wise compression of early LASzip versions, which pcfix cannot"
            sentence += " read. Convert it with LAStools (laszip) or CloudCompare."
        raise bad_file(path, "cloud.damaged", sentence) from error


class LasSource:
    """An open LAS or LAZ file; use it as a context manager.

    It has `path`, laspy's `header`, `vlrs` and `evlrs` from `read_records`, and `identity`: system
    identifier, generating software and date as they are in the file, where other software writes
    what laspy would not.
    """

    def __init__(self, path: File, jobs: int | None = None) -> None:
        """Open; an `InputError` if the file is missing, damaged, empty, or its scales unusable."""
        self.path, self._clouds = check_input(path), current().clouds
        with las_errors(self.path), ExitStack() as stack:
            with self.path.open("rb") as stream:
                others = {b"ply\n": "PLY", b"ply\r": "PLY", b"ASTM": "E57"}
                if other := others.get(stream.read(4)):
                    sentence = f"is a {other} file. Convert it to LAZ with CloudCompare or PDAL."
                    raise bad_file(self.path, "cloud.ply", sentence)
                self.vlrs, self.evlrs = read_records(stream)
                stream.seek(IDENTITY_PLACE)
                self.identity = stream.read(68)
            reader = laspy.open(self.path.open("rb"), laz_backend=backend(jobs))
            self._reader = stack.enter_context(reader)
            self.header: laspy.LasHeader = reader.header
            scales, offsets = self.header.scales, self.header.offsets
            usable = (scales > 0.0) & (scales <= MOST_SCALE_M)
            # steps below the last digit of the offsets would be lost in coordinates
            if not (usable & (np.abs(offsets) * np.finfo(np.float64).eps <= scales)).all():
                sentence = f"the scales {scales.tolist()} of its header are not between 0 and"
                sentence += f" {MOST_SCALE_M:,.0f}, or too small for its offsets"
                sentence += f" {offsets.tolist()}. Export the cloud again."
                raise bad_file(self.path, "cloud.scales", sentence)
            if len(self) == 0:
                raise bad_file(self.path, "cloud.empty", "contains no points.")
            # points that the header does not count would be lost
            least, most = self._points_held()
            if not least <= len(self) <= most:
                held = f"{least:,}" if least == most else f"{least:,} to {most:,}"
                sentence = f"its header counts {len(self):,} points, but it holds {held}."
                sentence += " Export it again."
                raise bad_file(self.path, "cloud.count", sentence, stated=len(self))
            stack.pop_all()

    def __enter__(self) -> "LasSource":
        return self

    def __exit__(self, *exception: object) -> None:
        self._reader.close()

    def __len__(self) -> int:
        return int(self.header.point_count)

    def _points_held(self) -> tuple[int, float]:
        """Return the least and the largest number of points that the file may hold.

        A file that is cut short is found on reading.
        """
        start, record = self.header.offset_to_point_data, self.header.point_format.size
        size = self.path.stat().st_size
        if not self.header.are_points_compressed:
            for name in ("start_of_first_evlr", "start_of_waveform_data_packet_record"):
                place = getattr(self.header, name, None) or 0
                size = min(size, place) if place > start else size
            held = (size - start) // record
            with self.path.open("rb") as stream:
                stream.seek(start + len(self) * record)
                is_padded = held > len(self) and not any(stream.read(record))
            return len(self) if is_padded else held, np.inf
        laszip = next((v.record_data for v in self.vlrs if v.user_id == "laszip encoded"), b"")
        (compressor,) = struct.unpack_from("<H", laszip)
        (chunk_points,) = struct.unpack_from("<I", laszip, 12)
        if compressor == 1 or chunk_points == 2**32 - 1:  # one stream, or chunks of any size
            return 0, np.inf
        with self.path.open("rb") as stream:
            stream.seek(start)
            (table,) = struct.unpack("<q", stream.read(8))
            if table == -1:  # written by software that cannot seek backwards
                stream.seek(-8, os.SEEK_END)
                (table,) = struct.unpack("<q", stream.read(8))
            if not start + 8 <= table <= size - 8:
                raise ValueError(f"its chunk table is at byte {table:,} of {size:,}")
            stream.seek(table + 4)
            (chunks,) = struct.unpack("<I", stream.read(4))
            if not 0 < chunks <= table - start:  # lazrs would take memory for all of them
                raise ValueError(f"{chunks:,} chunks in {table - start:,} bytes")
            last = 1
            if compressor == 3:  # dimensions are separate; these chunks state how many points
                stream.seek(start)
                sizes = [size for _, size in lazrs.read_chunk_table(stream, lazrs.LazVlr(laszip))]
                stream.seek(start + 8 + sum(sizes[:-1]) + record)
                (last,) = struct.unpack("<I", stream.read(4))
        return (chunks - 1) * chunk_points + last, chunks * chunk_points

    def chunks(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield all points in order, at most `CHUNK_POINTS` at a time.

        An `InputError` if the file ends before its last point.
        """
        clouds = self._clouds
        if clouds is not None and self.path in clouds:
            yield from clouds[self.path]
            return
        size = self.header.point_format.size
        is_small = len(self) * size <= 250_000_000  # then it stays in memory until it is read again
        read, chunks = 0, list[laspy.ScaleAwarePointRecord]()
        most = max(1, min(CHUNK_POINTS, 500_000_000 // size))  # fewer points if records are long
        while read < len(self):
            with las_errors(self.path):
                points = self._reader.read_points(most)
            if len(points) < min(most, len(self) - read):
                held = f"{read + len(points):,} of {len(self):,} points"
                sentence = f"it ends after {held}. Copy it again."
                raise bad_file(self.path, "cloud.count", sentence, stated=len(self))
            read += len(points)
            if clouds is not None and is_small:
                chunks.append(points)
            yield points
        if clouds is not None and is_small:
            clouds[self.path] = chunks

    def dimension(self, points: laspy.ScaleAwarePointRecord, name: str) -> FloatArray:
        """Return one dimension of a chunk, scaled, as float64.

        An `InputError` if the cloud has no such dimension.
        """
        names = list(self.header.point_format.dimension_names)
        if name not in names:
            extra = list(self.header.point_format.extra_dimension_names)
            listing = f"its extra dimensions are {', '.join(extra)}" if extra else "it has none"
            sentence = f"has no dimension {name}; {listing}."
            raise bad_file(self.path, "cloud.no_dimension", sentence, dimension=name)
        return np.asarray(points[name], dtype=np.float64)


def backend(jobs: int | None) -> laspy.LazBackend:
    """Return the LAZ backend: one thread when asked for one job, else all cores."""
    return laspy.LazBackend.Lazrs if jobs == 1 else laspy.LazBackend.LazrsParallel


def coordinates(points: laspy.ScaleAwarePointRecord) -> FloatArray:
    """Return x, y, z of a chunk, shape (n, 3), metres."""
    xyz = np.empty((len(points), 3))
    for axis, name in enumerate("XYZ"):  # four times as fast as all axes at once
        xyz[:, axis] = points.array[name] * points.scales[axis] + points.offsets[axis]
    return xyz


def read_xyz(path: File) -> FloatArray:
    """Return all coordinates of a cloud, shape (n, 3), metres."""
    with LasSource(path) as source:
        return np.vstack([coordinates(points) for points in source.chunks()])


def stated_crs(source: LasSource) -> "CRS | None":
    """Return the coordinate system of a cloud, or None; an `InputError` if it cannot be read.

    laspy does not read the vertical part of GeoTIFF keys.
    """
    from pyproj import CRS
    from pyproj.crs import CompoundCRS
    from pyproj.exceptions import CRSError

    try:
        with las_errors(source.path):
            crs: CRS | None = source.header.parse_crs()
        code = _geo_keys(source).get(4096, 0)
        if crs is not None and len(crs.axis_info) == 2 and 1024 <= code < _OWN_CODE:
            with suppress(CRSError):  # a code of a datum or an ellipsoid, as earlier software wrote
                vertical = CRS.from_epsg(code)
                if vertical.is_vertical:
                    crs = CRS(CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical]))
    except CRSError as error:
        sentence = f"its CRS cannot be read ({shortened(str(error))}). Set it again."
        raise bad_file(source.path, "cloud.crs", sentence) from error
    return crs


def _geo_keys(source: LasSource) -> dict[int, int]:
    """Return the values of the GeoTIFF keys that name the CRS; none if it is WKT."""
    if any((vlr.user_id, vlr.record_id) == ("LASF_Projection", 2112) for vlr in source.vlrs):
        return {}
    listed = source.header.vlrs.get("GeoKeyDirectoryVlr")
    keys = (key for vlr in listed for key in vlr.geo_keys if key.tiff_tag_location == 0)
    return {key.id: key.value_offset for key in keys}


def metric_crs(source: LasSource) -> "CRS | None":
    """Return the coordinate system of a cloud in metres, or None if it states none.

    An `InputError` if its coordinates or heights are in degrees, feet or another unit.
    """
    crs, keys = stated_crs(source), _geo_keys(source)
    name, axes = ("", []) if crs is None else (crs.name, crs.axis_info)
    # GeoTIFF keys may state other units of plan and heights than the CRS has
    codes = {keys.get(key, 9001) for key in (3076, 4099)}
    units = {_UNITS.get(code, f"EPSG:{code}") for code in codes if 0 < code < _OWN_CODE}
    units |= {axis.unit_name for axis in axes}
    if not units.issubset(METRES):
        unit = " and ".join(sorted(units.difference(METRES)))
        sentence = f"its CRS {name} is in {unit}. Reproject it to metres first."
        raise bad_file(source.path, "cloud.crs_unit", sentence, crs=name)
    return crs
