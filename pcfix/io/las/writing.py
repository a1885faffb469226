"""Write a LAS or LAZ file: its header from that of its input and the way back, its points.

A VLR records what pcfix did and the header before. Points go chunk by chunk into a temporary file,
which is renamed when it is complete.
"""

import hashlib
import json
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
from laspy.errors import LaspyException
from laspy.vlrs.known import WktCoordinateSystemVlr
from laspy.vlrs.vlr import VLR
from pyproj import CRS

from pcfix.errors import SettingError, bad_file
from pcfix.io.files import cannot_write, check_output, parse_json, refusing, temporary_output
from pcfix.io.las.columns import UPGRADE, Column, column_scale
from pcfix.io.las.source import (
    IDENTITY_PLACE,
    LasSource,
    Record,
    RecordList,
    append_evlrs,
    backend,
    stated_crs,
)
from pcfix.model import FloatArray
from pcfix.options.declare import File
from pcfix.version import __version__

EXTRA_BYTES = ("LASF_Spec", 4)
# An extra dimension: type, options, name, scale, offset and description; both are given.
_EXTRA, _SCALED = struct.Struct("<2xBB32s76xd16xd16x32s"), 0b11000
_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32")
USER_ID = "pcfix"
# VLRs of pcfix: one of a correction, and one for each cleaning or labelling.
NOTES = {"settings": 1, "cleaning": 2, "labelling": 3}
_SEAL = "sha256"  # key of the checksum of the record: a changed record would restore another cloud


def output_header(
    source: LasSource, kind: str, content: dict[str, Any], columns: tuple[Column, ...] = ()
) -> laspy.LasHeader:
    """Return the header of an output cloud: LAS 1.4, the input's records, and pcfix's own.

    That is of a `kind` (see `NOTES`) with `content`; of a correction also with what the file was
    before. The `columns` are added as extra dimensions. An `InputError` if a cloud to be corrected
    already has a dimension of one of these names, or was corrected before.
    """
    old, is_correction = source.header, kind == "settings"
    if is_correction and any(is_ours(v) for v in source.vlrs):
        sentence = "was already corrected by pcfix. Use the original, or undo it: 'pcfix restore'."
        raise bad_file(source.path, "cloud.corrected", sentence)
    point_format = laspy.PointFormat(UPGRADE[old.point_format.id])
    point_format.dimensions.extend(old.point_format.extra_dimensions)
    described, undescribed = _described(source)
    for dimension in undescribed:
        size = dimension.num_bits // 8
        described.append(_EXTRA.pack(0, size, dimension.name.encode(), 0.0, 0.0, b""))
    for column in columns:
        name, description, dtype = column.name, column.description, column.dtype
        if name in old.point_format.dimension_names:
            sentence = f"already has a dimension {name}. Rename it, or use --dimensions none."
            raise bad_file(source.path, "cloud.dimension_exists", sentence, dimension=name)
        scale = column_scale(column, old.scales)
        scaled, offset = (None, None) if scale == 1.0 else (np.array([scale]), np.zeros(1))
        extra = laspy.ExtraBytesParams(name, dtype, description, offset, scaled)
        point_format.add_extra_dimension(extra)
        number = _TYPES.index(dtype) + 1
        options, step = (0, 0.0) if scaled is None else (_SCALED, scale)
        record = _EXTRA.pack(number, options, name.encode(), step, 0.0, description.encode())
        described.append(record)
    vlrs, crs = list(source.vlrs), None
    if old.point_format.id < 6 and not old.global_encoding.wkt:  # formats 6 and up want WKT
        crs = stated_crs(source)
    if crs is not None:
        wkt = WktCoordinateSystemVlr(crs.to_wkt("WKT1_GDAL")).record_data_bytes()
        vlrs.append(VLR("LASF_Projection", 2112, "OGC COORDINATE SYSTEM WKT", wkt))
    if is_correction:
        before = {
            "version": str(old.version),
            "point_format": old.point_format.id,
            "identity": source.identity.decode("latin-1"),
            "global_encoding": old.global_encoding.value,
            "added_wkt": crs is not None,
            "undescribed": [dimension.name for dimension in undescribed],
        }
        content = {**content, "before": before}
        content[_SEAL] = _seal_of(content)
    vlrs.append(VLR(USER_ID, NOTES[kind], f"pcfix {kind} (JSON)", _json(content)))
    version = max(old.version, laspy.header.Version(1, 4))
    header = _header(source, version, point_format, vlrs, described)
    header.global_encoding.wkt = header.global_encoding.wkt or crs is not None
    return header


def restored_header(source: LasSource, before: dict[str, Any], drop: set[str]) -> laspy.LasHeader:
    """Return the header that a corrected file had before, by `before` of its own VLR.

    The extra dimensions that pcfix added go: `drop`.
    """
    extra = list(source.header.point_format.extra_dimensions)
    point_format = laspy.PointFormat(before["point_format"])
    point_format.dimensions.extend(d for d in extra if d.name not in drop)
    vlrs = [v for v in source.vlrs if not is_ours(v)]
    if before["added_wkt"]:
        del vlrs[max(i for i, v in enumerate(vlrs) if v.user_id == "LASF_Projection")]
    gone = drop.union(before["undescribed"])
    described = zip(_described(source)[0], extra, strict=False)
    records = [record for record, dimension in described if dimension.name not in gone]
    version = laspy.header.Version.from_str(before["version"])
    header = _header(source, version, point_format, vlrs, records)
    header.global_encoding.value = before["global_encoding"]
    return header


def _described(source: LasSource) -> tuple[list[bytes], list[Any]]:
    """Return the records of the input's extra dimensions, and the dimensions without a record."""
    dimensions = list(source.header.point_format.extra_dimensions)
    data = b"".join(v.record_data for v in source.vlrs if _is_extra_bytes(v))
    count = len(data) // _EXTRA.size if dimensions else 0
    records = [data[i * _EXTRA.size : (i + 1) * _EXTRA.size] for i in range(count)]
    return records, dimensions[count:]


def _header(
    source: LasSource, version: Any, point_format: laspy.PointFormat, vlrs: list[VLR],
    described: list[bytes],
) -> laspy.LasHeader:  # fmt: skip
    """Return a copy of the input's header with another format and other records.

    The description of the extra dimensions stays where it was among these, or comes last. laspy
    cannot write every name of the system and the software; `las_writer` does.
    """
    header = deepcopy(source.header)
    header.system_identifier = header.generating_software = ""
    header.set_version_and_point_format(version, point_format)
    places = [i for i, v in enumerate(vlrs) if _is_extra_bytes(v)]
    # those of LAZ and COPC describe how the input is laid out on disk
    layout = ("laszip encoded", "copc")
    records = RecordList(v for v in vlrs if not (_is_extra_bytes(v) or v.user_id in layout))
    data = b"".join(described)
    if data and places:
        head = vlrs[places[0]].head
        head = head[:20] + struct.pack("<H", len(data)) + head[22:]
        before = [v for v in vlrs[: places[0]] if v.user_id not in layout]
        records.insert(len(before), Record(head, data))
    elif data:
        records.append(VLR(*EXTRA_BYTES, "Extra Bytes Record", data))
    header._vlrs = records  # laspy's setter would rewrite some
    return header


def corrected_identity(source: LasSource) -> bytes:
    """Return the identity of a corrected or cleaned file: pcfix if changed, else the input's."""
    name = f"pcfix {__version__}".encode().ljust(32, b"\0")
    return source.identity[:32] + name + source.identity[64:]  # the generating software


def _is_extra_bytes(vlr: VLR) -> bool:
    return (vlr.user_id, vlr.record_id) == EXTRA_BYTES


def is_ours(vlr: VLR) -> bool:
    """Whether a VLR is the record of a correction."""
    return bool(vlr.user_id == USER_ID and vlr.record_id == NOTES["settings"])


def _json(content: dict[str, Any]) -> bytes:
    return json.dumps(content, ensure_ascii=True, separators=(",", ":")).encode()


def _seal_of(content: dict[str, Any]) -> str:
    return hashlib.sha256(_json(content)).hexdigest()[:16]


def own_settings(vlrs: Iterable[VLR]) -> Any:
    """Return the record of a correction, None without one; ValueError if it is no JSON."""
    ours = next((vlr for vlr in vlrs if is_ours(vlr)), None)
    return None if ours is None else parse_json(ours.record_data)


def read_settings(vlrs: Iterable[VLR], path: Path) -> dict[str, Any]:
    """Return the record of a correction.

    An `InputError` if there is none, or it is damaged.
    """
    with record_errors(path):
        content: dict[str, Any] | None = own_settings(vlrs)
        if content is not None and content.pop(_SEAL) != _seal_of(content):
            raise ValueError("its checksum differs")
    if content is None:
        sentence = "was not corrected by pcfix; there is nothing to undo."
        raise bad_file(path, "cloud.not_corrected", sentence)
    return content


def record_errors(path: Path) -> AbstractContextManager[None]:
    """Turn what a damaged VLR of a correction raises when it is used into one sentence."""
    sentence = "the record of its correction is damaged ({}). Use the original cloud."
    kinds = (ValueError, TypeError, LookupError, AttributeError, LaspyException)
    return refusing(path, "cloud.vlr_damaged", sentence, kinds)


def check_cloud(path: File, *, overwrite: bool, inputs: Iterable[File] = ()) -> Path:
    """Return the path of a cloud that may be written, by `check_output` and its suffix."""
    target = check_output(path, overwrite=overwrite, inputs=inputs)
    if target.name.lower().endswith(".copc.laz"):
        sentence = f"{path}: pcfix does not write COPC. Write .laz, and convert it with untwine."
        raise SettingError("output.copc", sentence, path=target)
    if target.suffix.lower() not in (".las", ".laz"):
        sentence = f"{path}: give an output name that ends in .las or .laz."
        raise SettingError("output.suffix", sentence, path=target)
    return target


@contextmanager
def las_writer(
    path: Path,
    header: laspy.LasHeader,
    evlrs: Sequence[Record] = (),
    identity: bytes = b"",
    jobs: int | None = None,
) -> Iterator[Callable[[laspy.ScaleAwarePointRecord], None]]:
    """Give a function that appends points, in the header's format and scale, to a new file.

    The suffix of its path decides between LAS and LAZ; the `evlrs` follow the points, and
    `identity` goes into the header as it is (see `LasSource`).
    """
    laz = path.suffix.lower() == ".laz"
    with temporary_output(path) as temporary, temporary.open("w+b") as stream:
        try:
            writer = laspy.LasWriter(
                stream, header, do_compress=laz, laz_backend=backend(jobs), closefd=False
            )
            yield writer.write_points
            writer.close()
            append_evlrs(stream, evlrs, header.version.minor)
            stream.seek(IDENTITY_PLACE)
            stream.write(identity)
        except (LaspyException, lazrs.LazrsError) as error:
            raise cannot_write(path, error, temporary) from error


def write_points(
    path: Path,
    xyz: FloatArray,
    place: tuple[CRS | str | int | None, float],
    colours: FloatArray | None = None,
    classes: np.ndarray | None = None,
) -> None:
    """Write points (n, 3), metres, as a new LAS or LAZ file, perhaps with colours of 16 bits."""
    crs, step_m = place  # what pyproj takes, and the step of coordinates in metres
    header = laspy.LasHeader(version="1.4", point_format=6 if colours is None else 7)
    header.scales = np.full(3, step_m)
    header.offsets = np.floor(xyz.min(axis=0))
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    header.generating_software = f"pcfix {__version__}"
    points = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
    for axis, name in enumerate("XYZ"):
        points.array[name] = np.rint((xyz[:, axis] - header.offsets[axis]) / step_m)
    points["return_number"][:] = points["number_of_returns"][:] = 1
    if classes is not None:
        points.array["classification"] = classes
    if colours is not None:
        for i, name in enumerate(("red", "green", "blue")):
            points.array[name] = colours[:, i]
    with las_writer(path, header) as write:
        write(points)
