"""Transform cameras from the frame of their file to the cloud's CRS.

PROJ transforms every centre. A rotation is transformed at its own centre: steps along the source's
axes become three vectors in the target, and the closest rotation turns the camera. This includes
the meridian convergence between maps, and geocentric or topocentric axes. It excludes the scale of
the map, 0.9996 on the central meridian of UTM, which heights do not have: 0.8 px at the edge of an
image of 4000 px. A cloud in map coordinates has the same error.

Heights are transformed only if both sides state their vertical datum. Otherwise they do not change.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import PcfixWarning, bad_file
from pcfix.io import crs as systems
from pcfix.model import Cameras, FloatArray

if TYPE_CHECKING:
    from pyproj import CRS

LARGEST_DEG = 360.0 + 1e-6
STEP_M, EARTH_RADIUS_M = 10.0, 6.4e6  # about half the distance over which directions are compared


class Frame(NamedTuple):
    """A frame that is tied to the earth.

    `enter` transforms points (n, 3) to `crs`, which is not geocentric. In a `direct` frame they are
    in `crs` already. A `topocentric` frame has axes east, north, up at a place.
    """

    crs: "CRS"
    enter: Callable[[FloatArray], FloatArray]
    direct: bool = False
    topocentric: bool = False

    def check(self, xyz: FloatArray, labels: Sequence[str], name: str) -> None:
        """Raise InputError for numbers that are not on the earth."""
        if self.topocentric or self.crs.is_projected:
            return
        code, kind = "cameras.degrees", "longitude and latitude"
        bad = (np.abs(xyz[:, :2]) > [LARGEST_DEG, LARGEST_DEG / 4.0]).any(axis=1)
        if not self.direct:
            code, kind = "cameras.geocentric", "geocentric coordinates"
            bad = np.abs(np.linalg.norm(xyz, axis=1) - EARTH_RADIUS_M) > 0.6e6
        if bad.any():
            label = labels[int(np.argmax(bad))]
            sentence = f"the coordinates of image {label} are not {kind}. Give --cameras-crs."
            raise bad_file(name, code, sentence, image=label, crs=self.crs.name)


def frame_of(text: str, name: str) -> Frame:
    """Return the frame that a text names: a CRS, or ``ENU:latitude,longitude,height``."""
    if systems.is_topocentric(text):
        place = systems.Topocentric.from_text(text, name)
        crs = systems.parse_crs("EPSG:4979", name)
        return Frame(crs, place.to_degrees, topocentric=True)
    crs = systems.parse_crs(text, name)
    if crs.is_geocentric:
        from pyproj import Transformer

        geographic = systems.geographic_3d(crs)  # on the same datum
        step = Transformer.from_crs(crs, geographic, always_xy=True)
        return Frame(geographic, lambda xyz: np.column_stack(step.transform(*xyz.T)))
    if not (crs.is_projected or crs.is_geographic):
        sentence = f"{crs.name} is not a CRS for cameras. Give another with --cameras-crs."
        raise bad_file(name, "cameras.crs", sentence, crs=crs.name)
    return Frame(crs, lambda xyz: xyz, direct=True)


def is_tied(crs: str | None, name: str) -> bool:
    """Whether a frame has its place on the earth."""
    return crs is not None and (systems.is_topocentric(crs) or _on_earth(crs, name) is not None)


def _on_earth(crs: str | None, name: str) -> "CRS | None":
    """Return a CRS that is tied to the earth; None for axes at a place and local frames."""
    parsed = None if crs is None else systems.parse_crs(crs, name)
    return None if parsed is None or systems.is_local(parsed) else parsed


@dataclass(frozen=True, eq=False)
class Georeference:
    """The transformation from the frame of a camera file into another CRS."""

    name: str  # of the file, for messages
    offset: FloatArray  # (3,), added to points of the file first
    crs: str | None  # of the result, as in `Cameras.crs`
    notes: tuple[PcfixWarning, ...] = ()
    frame: Frame | None = None  # of the file; None if the numbers do not change
    forward: systems.Move = systems.unchanged

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras in the target; `gnss` stays in its own CRS."""
        centres, rotations = self.points(cameras.centres), cameras.rotations
        numbers = cameras.centres + self.offset
        lost = ~np.isfinite(centres).all(axis=1)
        if lost.any():
            i = int(np.argmax(lost))
            x, y, z = numbers[i]
            sentence = f"image {cameras.labels[i]}: {x:.10g}, {y:.10g}, {z:.6g} is outside"
            sentence += f" {systems.shortened(self.crs or '')}. Check --cameras-crs."
            raise bad_file(self.name, "cameras.not_transformed", sentence, image=cameras.labels[i])
        if rotations is not None and self.frame is not None:
            rotations = rotations @ self._turns(self.frame, numbers).transpose(0, 2, 1)
        found = replace(cameras, centres=centres, rotations=rotations, crs=self.crs)
        return replace(found, project_crs=None, notes=cameras.notes + self.notes)

    def points(self, xyz: FloatArray) -> FloatArray:
        """Return points (n, 3) in the target; NaN for those that cannot be transformed."""
        return np.where(np.isfinite(found := self.forward(xyz + self.offset)), found, np.nan)

    def _turns(self, frame: Frame, at: FloatArray) -> FloatArray:
        """Return the rotations from the source's axes to the target's at points (n, 3)."""
        crs, steps = frame.crs, STEP_M * np.eye(3)
        if frame.direct:  # about that many metres in the units of the axes
            unit = systems.plan_unit(crs)[1] * (EARTH_RADIUS_M if crs.is_geographic else 1.0)
            steps /= [unit, unit, abs(systems.metres_up(crs))]
        ahead, behind = (self.forward((at[:, None] + s).reshape(-1, 3)) for s in (steps, -steps))
        if not (np.isfinite(ahead).all() and np.isfinite(behind).all()):
            return np.full((len(at), 3, 3), np.nan)
        vectors = (ahead - behind).reshape(-1, 3, 3).transpose(0, 2, 1)
        if (np.linalg.det(vectors) < 0.0).any():
            sentence = f"the axes of {crs.name} are left-handed. Use another CRS."
            raise bad_file(self.name, "cameras.left_handed", sentence, crs=crs.name)
        u, _, v = np.linalg.svd(vectors)  # the nearest rotation, whatever the lengths of the axes
        return np.asarray(u @ v)


def georeference(
    cameras: Cameras,
    cloud_crs: "str | CRS | None",
    *,
    cameras_crs: str | None = None,
    offset_m: tuple[float, float, float] | None = None,
    name: str = "cameras",
) -> Georeference:
    """Return the transformation to the cloud's CRS, for cameras, tie points and others.

    The cameras are as a reader gave them, in the frame of the file `name`. The cloud's CRS is
    projected, in metres. If it is None, the target is the CRS in which the software delivers
    clouds, mostly that of the cameras.

    `cameras_crs` overrides the CRS in the file. ``local``: the numbers do not change. A CRS without
    heights states that these agree with the cloud's, and so does ``ENU:lat,lon,height``. For a file
    with geocentric positions it is the CRS in which its software delivers clouds, unless it is
    geocentric itself. `offset_m` is added to the centres first, in the axes and the unit of the
    cameras' frame.
    """
    offset = np.zeros(3) if offset_m is None else np.array(offset_m, np.float64)
    cloud = None if cloud_crs is None else systems.parse_crs(cloud_crs, "the cloud")
    # the frame of the cameras, and the CRS in which their software delivers clouds
    stated, project, given = cameras.crs, _on_earth(cameras.project_crs, name), cameras_crs or ""
    trusted = False  # heights of an unknown system are the cloud's
    if given.strip():
        stated, chosen = given.strip(), _on_earth(given, "--cameras-crs")
        if chosen is None or not chosen.is_geocentric:
            trusted = chosen is None or systems.heights_of(chosen) == "unstated"
            own = None if chosen is None else _on_earth(cameras.crs, name)
            is_project = own is not None and own.is_geocentric
            stated, project = (cameras.crs, chosen) if is_project else (stated, None)
    crs = stated or ""
    if not is_tied(stated, name):
        if cloud is None:
            return Georeference(name, offset, stated)
        if stated is not None and not given.strip() and not systems.is_local(cloud):
            sentence = f"is in a local frame, the cloud in {cloud.name}. Export the cameras in that"
            sentence += " CRS, or give --cameras-crs local to use their numbers as they are."
            raise bad_file(name, "cameras.local", sentence, cloud_crs=cloud.name)
        return Georeference(name, offset, systems.crs_text(cloud))
    if cloud is not None and systems.is_local(cloud):
        sentence = f"is in {systems.shortened(crs)}, the cloud in a local frame. Set the cloud's"
        sentence += " CRS, or give --cameras-crs local to use the numbers as they are."
        raise bad_file(name, "cloud.local", sentence, crs=crs, cloud_crs=cloud.name)
    frame, notes = frame_of(crs, name), list[PcfixWarning]()
    if cloud is None:
        is_map = frame.topocentric or (frame.direct and frame.crs.is_projected)
        if not is_map and (frame.direct or project is None or not project.is_projected):
            kind = "degrees" if frame.direct else "geocentric coordinates"
            sentence = f"is in {kind} ({frame.crs.name}). Give a cloud that names its CRS."
            raise bad_file(name, "cloud.no_crs", sentence, crs=frame.crs.name)
        cloud = frame.crs if is_map or project is None else project
        words = systems.shortened(crs) if frame.topocentric else cloud.name
        sentence = f"the cloud names no CRS; that of the cameras is assumed ({words})."
        notes.append(PcfixWarning("cloud.crs_assumed", f"{name}: {sentence}", path=name))
        if is_map:
            return Georeference(name, offset, stated, tuple(notes))
    systems.check_projected_metres(cloud, "the cloud")
    if frame.direct and frame.crs.is_geographic and offset.any():
        sentence = f"an offset in metres cannot be added to degrees ({frame.crs.name}). Omit it."
        raise bad_file(name, "cameras.offset", sentence, value=offset.tolist())
    target = cloud
    if systems.heights_of(cloud) == "unstated":  # then the heights are those that the software uses
        vertical = systems.parts(frame.crs if project is None else project)[1]
        target = cloud if vertical is None else systems.with_heights(cloud, vertical)
    here, (unit, size) = systems.heights_of(frame.crs), systems.plan_unit(frame.crs)
    assumed = "" if trusted else systems.assumed_heights(frame.crs, target)
    if here == "unstated" and frame.crs.is_projected and size != 1.0:
        assumed = f"heights are assumed to be in {unit}, like x and y."
    elif here == "ellipsoidal" and (project is not None or frame.topocentric):
        assumed = ""  # they are known to be
    # heights change only if both sides state different datums, and the user does not trust them
    heights = not ((trusted and not frame.direct) or systems.heights_agree(frame.crs, target))
    plan = systems.crs_text(systems.parts(frame.crs if frame.direct else target)[0])
    given = "ENU:latitude,longitude,height" if frame.topocentric else systems.shortened(plan)
    instead = f"or, if the heights of cameras and cloud agree, give --cameras-crs {given}"
    at = cameras.centres + offset
    frame.check(at, cameras.labels, name)
    forward, of_step = systems.transformation(
        frame.crs, target, frame.enter(at), name, heights=heights, instead=instead
    )
    notes += [PcfixWarning("crs.transformation", str(one), path=name) for one in of_step]
    if assumed:
        notes.append(PcfixWarning("cameras.heights_assumed", f"{name}: {assumed}", path=name))
    into, found = systems.crs_text(target), tuple(notes)
    if forward is systems.unchanged:
        return Georeference(name, offset, into, found)
    return Georeference(name, offset, into, found, frame, lambda xyz: forward(frame.enter(xyz)))


def adjusted_minus_gnss(cameras: Cameras, name: str = "cameras") -> tuple[FloatArray, str]:
    """Return adjusted centres minus GNSS positions, and the reason why some are not compared.

    The differences, shape (k, 3), are metres along the axes of the cameras' map, or else east,
    north, up. They are NaN for cameras without a position, and if the two cannot be compared, which
    often holds for heights. The cameras are as read or in the cloud's CRS; `name` is their file.
    """
    found = np.full((len(cameras), 3), np.nan)
    if cameras.gnss is None:
        return found, f"{name}: has no positions of the GNSS."
    crs, stated = cameras.crs or "", cameras.gnss.crs or cameras.crs
    is_plain = not is_tied(cameras.crs, name) or systems.is_topocentric(crs)
    if is_plain and stated == cameras.crs:  # metres of one frame
        return cameras.centres - cameras.gnss.xyz, ""
    if stated is None or not (is_tied(cameras.crs, name) and is_tied(stated, name)):
        reason = f"{name}: the cameras or the GNSS positions name no CRS; they are not compared."
        return found, reason
    rows = np.flatnonzero(np.isfinite(cameras.gnss.xyz).all(axis=1))
    if len(rows) == 0:
        return found, ""
    own, other = frame_of(crs, name), frame_of(stated, name)
    other.check(cameras.gnss.xyz[rows], [cameras.labels[i] for i in rows], name)
    adjusted, measured = own.enter(cameras.centres[rows]), other.enter(cameras.gnss.xyz[rows])
    kinds, reason = [systems.heights_of(one.crs) for one in (own, other)], ""
    if stated != crs and {"gravity", "unstated"} <= {*kinds}:
        who = "cameras" if kinds[0] == "unstated" else "GNSS"
        reason = f"{name}: the CRS of the {who} names no vertical datum; only plan is compared."
    heights = not (reason or stated == crs or systems.heights_agree(other.crs, own.crs))
    try:
        forward, _ = systems.transformation(other.crs, own.crs, measured, name, heights=heights)
    except systems.HeightsError as error:
        reason = str(error).partition("; or, if")[0].rstrip(".") + "; only plan is compared."
        forward, _ = systems.transformation(other.crs, own.crs, measured, name, heights=False)
    measured = forward(measured)
    unit = systems.plan_unit(own.crs)[1]
    off = (adjusted - measured) * [unit, unit, abs(systems.metres_up(own.crs))]
    if own.crs.is_geographic and (geod := own.crs.get_geod()) is not None:
        x, y, other_x, other_y = unit * np.hstack([measured[:, :2], adjusted[:, :2]]).T
        azimuth, _, metres = geod.inv(x, y, other_x, other_y, radians=True)
        off[:, :2] = np.column_stack([metres * np.sin(azimuth), metres * np.cos(azimuth)])
    found[rows] = off * [1.0, 1.0, np.nan] if reason else off
    return found, reason
