"""Write a LAS or LAZ file chunk by chunk, beside its target, and rename it when it is whole."""

from __future__ import annotations

from contextlib import ExitStack
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
from laspy.vlrs.known import ExtraBytesStruct, WktCoordinateSystemVlr
from laspy.vlrs.vlr import VLR
from laspy.vlrs.vlrlist import VLRList

import pcfix
from pcfix.errors import InputError, SettingError
from pcfix.io.files import replaced_when_whole
from pcfix.io.las.columns import Column, extra_bytes
from pcfix.io.las.formats import convert, upgraded
from pcfix.io.las.provenance import is_ours, settings_vlr
from pcfix.io.las.source import WAVEFORM_PACKETS, LasSource, backend, las_errors

if TYPE_CHECKING:
    from pathlib import Path

EXTRA_BYTES = ("LASF_Spec", 4)
_INT32 = np.iinfo(np.int32)
_ROOM_M = 100.0
"""How far a point may move before the offsets must give way; water that a camera sees through
is far shallower."""


def check_suffix(path: Path) -> bool:
    """Return whether a name asks for LAZ rather than LAS.

    Raises
    ------
    SettingError
        If it asks for neither.
    """
    suffix = path.suffix.lower()
    if suffix not in (".las", ".laz"):
        raise SettingError(f"{path}: give an output name that ends in .las or .laz.")
    return suffix == ".laz"


class LasSink:
    """An output file that is being written. Use it as a context manager; see `for_correction`."""

    def __init__(
        self, path: Path, header: laspy.LasHeader, evlrs: list[VLR], jobs: int | None = None
    ) -> None:
        self.header = header
        self._path, self._evlrs, self._jobs = path, evlrs, jobs
        self._stack = ExitStack()

    def __enter__(self) -> LasSink:
        laz = check_suffix(self._path)
        draft = self._stack.enter_context(replaced_when_whole(self._path))
        try:
            self._writer = laspy.LasWriter(
                draft.open("wb"), self.header, do_compress=laz, laz_backend=backend(self._jobs)
            )
        except BaseException as error:
            self._stack.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def write(self, points: laspy.ScaleAwarePointRecord) -> None:
        """Append points, in the header's format and scale."""
        with las_errors(self._path):
            self._writer.write_points(points)

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        try:
            if kind is None and self._evlrs:
                self._writer.write_evlrs(VLRList(self._evlrs))
                self._point_to_waveforms()
            self._writer.close()
        finally:
            self._stack.__exit__(kind, value, traceback)

    def _point_to_waveforms(self) -> None:
        position = self._writer.header.start_of_first_evlr
        for evlr in self._evlrs:
            if (evlr.user_id, evlr.record_id) == WAVEFORM_PACKETS:
                self._writer.header.start_of_waveform_data_packet_record = position
            position += 60 + len(evlr.record_data)


def offset_steps(header: laspy.LasHeader) -> list[int]:
    """Return by how many steps each integer axis must be moved to make room for the shift.

    Zero unless the coordinates come near the end of 32 bits.
    """
    low = (header.mins - header.offsets) / header.scales
    high = (header.maxs - header.offsets) / header.scales
    room = _ROOM_M / header.scales
    fits = (low - room >= _INT32.min) & (high + room <= _INT32.max)
    middle = np.where(np.isfinite(low + high), (low + high) / 2.0, 0.0)
    return [0 if ok else int(-np.rint(m)) for ok, m in zip(fits, middle, strict=True)]


def corrected_header(
    source: LasSource, columns: tuple[Column, ...], content: dict[str, Any], *, wide: bool
) -> laspy.LasHeader:
    """Return the header of a corrected file: LAS 1.4, the input's records, and pcfix's own.

    Parameters
    ----------
    source : LasSource
    columns : tuple of Column
        Extra dimensions to add.
    content : dict
        What the provenance VLR shall say; what the file was before is added to it.
    wide : bool
        Whether the columns have their wide types.

    Raises
    ------
    InputError
        If the cloud already has a dimension of one of these names, or was corrected before.
    """
    _refuse_twice(source, columns)
    old = source.header
    header = deepcopy(old)
    params, records = extra_bytes(columns, old.scales, wide=wide)
    point_format = upgraded(old.point_format)
    for param in params:
        point_format.add_extra_dimension(param)
    version = max(old.version, laspy.header.Version(1, 4))
    header.set_version_and_point_format(version, point_format)
    header.generating_software = f"pcfix {pcfix.__version__}"
    steps = offset_steps(old)
    header.offsets = old.offsets - np.array(steps) * old.scales

    vlrs = [v for v in source.vlrs if not _is_layout(v)]
    wkt = _wkt_for(header, source)
    before = {
        "version": str(old.version),
        "point_format": old.point_format.id,
        "generating_software": _text(old.generating_software),
        "global_encoding": old.global_encoding.value,
        "offsets": old.offsets.tolist(),
        "steps": steps,
        "added_wkt": wkt is not None,
    }
    if wkt is not None:
        vlrs.append(wkt)
        header.global_encoding.wkt = True
    vlrs.append(settings_vlr({**content, "before": before}))
    _set_records(header, vlrs, _extra_bytes_of(source) + records)
    return header


def restored_header(source: LasSource, before: dict[str, Any], drop: set[str]) -> laspy.LasHeader:
    """Return the header that a file had before it was corrected.

    Parameters
    ----------
    source : LasSource
        The corrected file.
    before : dict
        From its provenance VLR.
    drop : set of str
        The extra dimensions that pcfix added.
    """
    header = deepcopy(source.header)
    point_format = laspy.PointFormat(before["point_format"])
    kept = [d for d in source.header.point_format.extra_dimensions if d.name not in drop]
    point_format.dimensions.extend(kept)
    header.set_version_and_point_format(
        laspy.header.Version.from_str(before["version"]), point_format
    )
    header.generating_software = before["generating_software"]
    header.global_encoding.value = before["global_encoding"]
    header.offsets = np.array(before["offsets"], dtype=np.float64)
    vlrs = [v for v in source.vlrs if not _is_layout(v) and not is_ours(v)]
    if before["added_wkt"]:
        last = max(i for i, v in enumerate(vlrs) if v.user_id == "LASF_Projection")
        del vlrs[last]
    size = ExtraBytesStruct.size()
    records = _extra_bytes_of(source)
    described = [records[i : i + size] for i in range(0, len(records), size)]
    names = [d.name for d in source.header.point_format.extra_dimensions]
    kept_records = [r for r, name in zip(described, names, strict=True) if name not in drop]
    _set_records(header, vlrs, b"".join(kept_records))
    return header


def output_evlrs(source: LasSource) -> list[VLR]:
    """Return the EVLRs to carry over: all but the index of a COPC file, which would be wrong."""
    return [v for v in source.evlrs if v.user_id != "copc"]


def write_shifted(
    points: laspy.ScaleAwarePointRecord,
    header: laspy.LasHeader,
    path: Path,
    steps: np.ndarray,
) -> laspy.ScaleAwarePointRecord:
    """Return points in the header's format, moved by whole steps of its scale, shape (n, 3).

    Raises
    ------
    InputError
        If a coordinate leaves the 32 bits that LAS has.
    """
    new = convert(points, header.point_format)
    for axis, name in enumerate("XYZ"):
        moved = points.array[name].astype(np.int64) + steps[:, axis]
        if moved.size and (moved.min() < _INT32.min or moved.max() > _INT32.max):
            raise InputError(
                f"{path}: the scale {header.scales[axis]:g} of {name} is too fine to hold the"
                " result in 32 bits; write the cloud with a coarser scale first."
            )
        new.array[name] = moved
    new.offsets = header.offsets
    return new


def _refuse_twice(source: LasSource, columns: tuple[Column, ...]) -> None:
    if any(is_ours(v) for v in source.vlrs):
        raise InputError(
            f"{source.path}: was corrected by pcfix already; use the original, or get it back"
            " with 'pcfix restore'."
        )
    there = set(source.header.point_format.dimension_names)
    for column in columns:
        if column.name in there:
            raise InputError(
                f"{source.path}: has a dimension {column.name} already, which pcfix would write;"
                " rename it, or use --dimensions none."
            )


def _is_layout(vlr: VLR) -> bool:
    """Whether a record describes how this very file is laid out on disk."""
    return vlr.user_id in ("laszip encoded", "copc")


def _is_extra_bytes(vlr: VLR) -> bool:
    return (vlr.user_id, vlr.record_id) == EXTRA_BYTES


def _extra_bytes_of(source: LasSource) -> bytes:
    """Return the description of the input's extra bytes, undocumented ones included."""
    dimensions = list(source.header.point_format.extra_dimensions)
    records = b"".join(v.record_data for v in source.vlrs if _is_extra_bytes(v))
    described = len(records) // ExtraBytesStruct.size() if dimensions else 0
    records = records[: described * ExtraBytesStruct.size()]
    for dimension in dimensions[described:]:
        record = ExtraBytesStruct(dimension.name.encode(), (0, dimension.num_bits // 8))
        records += bytes(record)
    return records


def _set_records(header: laspy.LasHeader, vlrs: list[VLR], extra_bytes_records: bytes) -> None:
    """Put raw records in the header; in place, as laspy's setter would rewrite some.

    The description of the extra bytes stays where it was, or comes last.
    """
    places = [i for i, v in enumerate(vlrs) if _is_extra_bytes(v)]
    records = [v for v in vlrs if not _is_extra_bytes(v)]
    if extra_bytes_records:
        place = places[0] if places else len(records)
        described = vlrs[places[0]].description if places else "Extra Bytes Record"
        records.insert(place, VLR(*EXTRA_BYTES, described, extra_bytes_records))
    header.vlrs.clear()
    header.vlrs.extend(records)


def _wkt_for(header: laspy.LasHeader, source: LasSource) -> VLR | None:
    """Return the CRS as WKT, which formats 6 and up want, where the input has only GeoTIFF keys."""
    if source.header.point_format.id >= 6 or header.global_encoding.wkt:
        return None
    with las_errors(source.path):
        crs = source.header.parse_crs()
    if crs is None:
        return None
    wkt = WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL"))
    return VLR("LASF_Projection", 2112, "OGC COORDINATE SYSTEM WKT", wkt.record_data_bytes())


def _text(value: str | bytes) -> str:
    return value.decode("latin-1") if isinstance(value, bytes) else value
