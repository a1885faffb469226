"""Clouds that use all that LAS allows, and a reader of LAS files that knows only the standard."""

import struct
from datetime import date
from pathlib import Path
from typing import NamedTuple
from uuid import UUID

import laspy
import numpy as np
from laspy.vlrs.vlrlist import VLRList
from pyproj import CRS

from pcfix import Cameras, Lens

WATER_M = 12.40005  # no coordinate of `random_cloud` lies on it
EAST_M, NORTH_M, SIDE_M = 456_000.0, 5_432_000.0, 120.0
CAMERA_HEIGHT_M = 75.0
SCALES, OFFSETS = (0.0013, 0.0007, 0.0011), (455_987.25, 5_431_990.5, -3.7)

VERSION = {n: "1.2" if n < 4 else "1.3" if n < 6 else "1.4" for n in range(11)}

XYZ = [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2")]
OLD = [*XYZ, ("bits", "u1"), ("class_bits", "u1"), ("angle", "i1"), ("user", "u1"), ("src", "<u2")]
NEW = [*XYZ, ("returns", "u1"), ("flags", "u1"), ("class", "u1"), ("user", "u1"), ("angle", "<i2")]
NEW += [("src", "<u2"), ("gps", "<u8")]
GPS = [("gps", "<u8")]
RGB = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
NIR = [("nir", "<u2")]
WAVE = [("wave_index", "u1"), ("wave_offset", "<u8"), ("wave_size", "<u4"), ("wave_place", "<u4")]
WAVE += [("wave_x", "<u4"), ("wave_y", "<u4"), ("wave_z", "<u4")]
# LAS 1.4 R15, tables 7 to 18. Floats are read as integers, so that bits are compared.
RECORD = {
    0: OLD, 1: OLD + GPS, 2: OLD + RGB, 3: OLD + GPS + RGB,
    4: OLD + GPS + WAVE, 5: OLD + GPS + RGB + WAVE,
    6: NEW, 7: NEW + RGB, 8: NEW + RGB + NIR, 9: NEW + WAVE, 10: NEW + RGB + NIR + WAVE,
}  # fmt: skip

EXTRA_TYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4"}


class Record(NamedTuple):
    """A (extended) variable length record, as it is on disk."""

    user_id: bytes
    record_id: int
    description: bytes
    data: bytes

    @property
    def kind(self) -> tuple[bytes, int]:
        return self.user_id.rstrip(b"\0"), self.record_id


class RawLas(NamedTuple):
    """What a LAS or LAZ file holds; `points` are bytes, one row a point."""

    header: bytes
    version: tuple[int, int]
    point_format: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    records: list[Record]
    extended: list[Record]
    points: np.ndarray

    def foreign(self) -> list[Record]:
        """Records that do not describe the layout of this file, nor come from pcfix."""
        ours = (b"LASF_Spec", 4), (b"laszip encoded", 22204), (b"pcfix", 1)
        return [record for record in self.records if record.kind not in ours]

    def extra_bytes(self) -> bytes:
        """The data of the ExtraBytes record."""
        return b"".join(r.data for r in self.records if r.kind == (b"LASF_Spec", 4))


def read_raw(path: Path) -> RawLas:
    """Read a file by the standard; only LAZ points are left to laspy."""
    data = path.read_bytes()
    version = (data[24], data[25])
    (size,) = struct.unpack_from("<H", data, 94)
    start, count, format_byte, length, points = struct.unpack_from("<IIBHI", data, 96)
    extended: list[Record] = []
    if version >= (1, 4):
        place, number, points = struct.unpack_from("<QIQ", data, 235)
        extended = _records(data, place, number, "<2x16sHQ32s") if number else []
    elif version == (1, 3) and data[6] & 2:
        extended = _records(data, *struct.unpack_from("<Q", data, 227), 1, "<2x16sHQ32s")
    if format_byte & 0x80:
        rows = np.ascontiguousarray(laspy.read(path).points.array).view(np.uint8)
    else:
        rows = np.frombuffer(data, np.uint8, points * length, start)
    return RawLas(
        header=data[:size],
        version=version,
        point_format=format_byte & 0x3F,
        scales=struct.unpack_from("<3d", data, 131),
        offsets=struct.unpack_from("<3d", data, 155),
        records=_records(data, size, count, "<2x16sHH32s"),
        extended=extended,
        points=rows.reshape(points, length),
    )


def _records(data: bytes, place: int, count: int, layout: str) -> list[Record]:
    found = []
    for _ in range(count):
        user_id, record_id, length, description = struct.unpack_from(layout, data, place)
        place += struct.calcsize(layout)
        found.append(Record(user_id, record_id, description, data[place : place + length]))
        place += length
    return found


def fields(raw: RawLas) -> dict[str, np.ndarray]:
    """Return every field of the point records, bit fields apart, and the extra bytes."""
    dtype = np.dtype(RECORD[raw.point_format])
    packed = np.ascontiguousarray(raw.points[:, : dtype.itemsize]).view(dtype)[:, 0]
    out = {name: packed[name] for name in dtype.names}
    if raw.point_format < 6:
        bits, classes = out.pop("bits"), out.pop("class_bits")
        out |= {"return": bits & 7, "of": bits >> 3 & 7, "scan": bits >> 6 & 1, "edge": bits >> 7}
        out |= {"class": classes & 31, "synthetic": classes >> 5 & 1, "key": classes >> 6 & 1}
        out["withheld"] = classes >> 7
    else:
        returns, flags = out.pop("returns"), out.pop("flags")
        out |= {"return": returns & 15, "of": returns >> 4}
        out |= {"synthetic": flags & 1, "key": flags >> 1 & 1, "withheld": flags >> 2 & 1}
        out |= {"overlap": flags >> 3 & 1, "channel": flags >> 4 & 3}
        out |= {"scan": flags >> 6 & 1, "edge": flags >> 7}
    return out | {"extra": raw.points[:, dtype.itemsize :]}


def described(raw: RawLas) -> list[tuple[str, int, float]]:
    """Return name, type and scale of each extra dimension."""
    data = raw.extra_bytes()
    return [
        (
            data[i + 4 : i + 36].rstrip(b"\0").decode(),
            data[i + 2],
            struct.unpack_from("<d", data, i + 112)[0] if data[i + 3] & 8 else 1.0,
        )
        for i in range(0, len(data), 192)
    ]


def added(before: RawLas, after: RawLas) -> dict[str, np.ndarray]:
    """Return the raw integers of the dimensions that `after` has behind those of `before`."""
    listed = described(after)[len(before.extra_bytes()) // 192 :]
    dtype = np.dtype([(name, EXTRA_TYPES[number]) for name, number, _ in listed if number])
    if not dtype.names:
        return {}
    tail = after.points[:, after.points.shape[1] - dtype.itemsize :]
    packed = np.ascontiguousarray(tail).view(dtype)[:, 0]
    return {name: packed[name] for name in dtype.names}


def xyz_of(raw: RawLas) -> np.ndarray:
    """Return the coordinates, metres."""
    whole = fields(raw)
    return np.column_stack([whole[a] for a in "XYZ"]) * raw.scales + raw.offsets


def random_cloud(
    point_format: int,
    *,
    version: str | None = None,
    count: int = 2000,
    scales: tuple[float, ...] = SCALES,
    offsets: tuple[float, ...] = OFFSETS,
    seed: int = 7,
    plain: bool = False,
) -> laspy.LasData:
    """Return a cloud in which every bit that may vary does; a third of it lies under water.

    `plain` leaves out extra dimensions and records.
    """
    rng = np.random.default_rng([seed, point_format])
    header = laspy.LasHeader(version=version or VERSION[point_format], point_format=point_format)
    header.scales, header.offsets = np.array(scales), np.array(offsets)
    header.creation_date = date(2021, 2, 3)
    header.uuid, header.file_source_id = UUID(int=0x1234567890ABCDEF), 4711
    header.system_identifier, header.generating_software = "Camera, drone (v2)", "Maker & Sons"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    if not plain:
        _add_records(header, rng)
    elif point_format >= 6:
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.points = laspy.ScaleAwarePointRecord.zeros(count, header=header)
    array = las.points.array
    # random bits in every field; floats that a header may count stay finite
    array[:] = np.frombuffer(rng.bytes(array.nbytes), array.dtype)
    for name in ("gps_time", "Precise", "Normal"):
        if name in array.dtype.names:
            array[name] = rng.normal(0.0, 1e5, array[name].shape)
    xyz = rng.uniform((EAST_M, NORTH_M, 4.0), (EAST_M + SIDE_M, NORTH_M + SIDE_M, 30.0), (count, 3))
    for axis, name in enumerate("XYZ"):
        array[name] = np.rint((xyz[:, axis] - offsets[axis]) / scales[axis])
    if las.header.version.minor >= 4 and not plain:
        las.evlrs = VLRList(
            [
                laspy.VLR("Inventor & Co", 7, "an extended one", rng.bytes(70_001)),
                laspy.VLR("Inventor & Co", 7, "the same again", b""),
            ]
        )
    return las


def _add_records(header: laspy.LasHeader, rng: np.random.Generator) -> None:
    """Add foreign records, extra dimensions, and the CRS as the format has it."""
    names = (b"Unclassified", b"Low veg. (<2 m)", b"Water / sea-bed", b"Rocks & 'more'")
    lookup = b"".join(struct.pack("<B15s", 60 + i, name) for i, name in enumerate(names))
    header.vlrs.append(laspy.VLR("Inventor & Co", 42, "Made up; 100 %", rng.bytes(333)))
    header.vlrs.append(laspy.VLR("LASF_Spec", 0, "Classes", lookup))
    p = laspy.ExtraBytesParams
    header.add_extra_dims(
        [
            p("Quality", "int16", "scaled", offsets=[10.0], scales=[0.25]),
            p("Level", "uint8", "plain"),
            p("Precise", "float64", ""),
            p("Normal", "3f4", "unit vector"),
            p("Blob", "4u1", "undocumented"),
            p("Echo", "uint16", "no data 65535", no_data=[65535]),
        ]
    )
    header.add_crs(CRS.from_epsg(32633))
    header.vlrs.append(laspy.VLR("Inventor & Co", 42, "", b""))
    header.vlrs.append(laspy.VLR("Someone", 65535, "an exactly full description 31c", b"\0\1\2"))


def write_cloud(path: Path, point_format: int, **choices: object) -> Path:
    """Write `random_cloud` and return the path.

    A LAZ with waveforms gets one scanner channel: lazrs 0.8.2 mixes up the waveforms of several.
    """
    las = random_cloud(point_format, **choices)
    if path.suffix == ".laz" and point_format in (9, 10):
        las.scanner_channel[:] = 2
    las.write(path)
    return path


def write_las(
    path: Path,
    xyz: np.ndarray,
    classes: object = 0,
    *,
    crs: object = 32633,
    withheld: object = 0,
    scale: float = 0.001,
    offsets: object = None,
    **extra: np.ndarray,
) -> Path:
    """Write points, by default in steps of a millimetre, and return the path."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, scale)
    header.offsets = np.floor(np.min(xyz, axis=0)) if offsets is None else np.array(offsets)
    for name in extra:
        header.add_extra_dim(laspy.ExtraBytesParams(name, "float64"))
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.xyz = np.asarray(xyz)
    las.classification = np.broadcast_to(classes, len(xyz))
    las.withheld = np.broadcast_to(withheld, len(xyz))
    for name, values in extra.items():
        las[name] = values
    las.write(path)
    return path


def block(side: int = 3) -> Cameras:
    """Return side x side projection centres over the cloud, without angles."""
    steps = np.linspace(0.1, 0.9, side) * SIDE_M
    x, y = (grid.ravel() for grid in np.meshgrid(EAST_M + steps, NORTH_M + steps))
    centres = np.column_stack([x, y, np.full(side * side, WATER_M + CAMERA_HEIGHT_M)])
    return Cameras(tuple(f"c{i}" for i in range(len(centres))), centres)


def framed_block() -> Cameras:
    """Return the same cameras looking straight down.

    Their frames reach half their height to east and west, a fifth to north and south.
    """
    plain = block()
    rotations = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (len(plain), 3, 3)).copy()
    lens = Lens(focal=24.0, width=24.0, height=9.6, principal_x=12.0, principal_y=4.8)
    return Cameras(plain.labels, plain.centres, rotations, (lens,) * len(plain))


def cameras_csv(path: Path, cameras: Cameras, angles: bool = False) -> Path:
    """Write a camera table and return its path."""
    tail = (",yaw,pitch,roll", ",0,0,0") if angles else ("", "")
    lines = [
        f"{label},{x:.3f},{y:.3f},{z:.3f}{tail[1]}"
        for label, (x, y, z) in zip(cameras.labels, cameras.centres, strict=True)
    ]
    path.write_text("\n".join([f"label,x,y,z{tail[0]}", *lines]) + "\n")
    return path


def patched(path: Path, place: int, data: bytes) -> Path:
    """Overwrite bytes of a file and return its path."""
    with path.open("r+b") as stream:
        stream.seek(place)
        stream.write(data)
    return path


def add_undescribed_bytes(path: Path, count: int) -> Path:
    """Make the point records of a LAS file longer, and say nowhere what the new bytes are."""
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    raw = read_raw(path)
    tail = np.random.default_rng(3).integers(0, 256, (len(raw.points), count), np.uint8)
    struct.pack_into("<H", data, 105, raw.points.shape[1] + count)
    path.write_bytes(bytes(data[:start]) + np.hstack([raw.points, tail]).tobytes())
    return path


def add_waveforms(path: Path, packets: bytes) -> Path:
    """Append waveform packets to a LAS 1.3 file, as that version stores them."""
    data = bytearray(path.read_bytes())
    data[6] |= 2
    struct.pack_into("<Q", data, 227, len(data))
    data += struct.pack("<2x16sHQ32s", b"LASF_Spec", 65535, len(packets), b"waves") + packets
    path.write_bytes(bytes(data))
    return path


def occluder_of(xyz):
    """Return the surface of points that are the whole cloud; see `OccluderBuilder.add`."""
    from pcfix.refract.occlusion import OccluderBuilder

    builder = OccluderBuilder(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), len(xyz))
    builder.add(xyz)
    return builder.build()
