"""A photogroup: its lens, and the axes of its camera."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.xml import number
from pcfix.model import Lens

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.model import FloatArray

FIRST_PIXEL = 0.5
"""The centre of the first pixel, seen from its corner."""
DIRECTIONS = {"Right": (1, 0), "Left": (-1, 0), "Down": (0, 1), "Up": (0, -1)}
ORIENTATIONS = {
    f"X{x}Y{y}": np.array([(*DIRECTIONS[x], 0.0), (*DIRECTIONS[y], 0.0)])
    for x in DIRECTIONS
    for y in DIRECTIONS
    if (x in ("Right", "Left")) != (y in ("Right", "Left"))
}


class Photogroup:
    """What the photos of a group share; its numbers are read with messages that name the group."""

    def __init__(self, path: Path, element: Element) -> None:
        self.path = path
        self.element = element
        self.name = (element.findtext("Name") or "without a name").strip()

    def number(self, name: str) -> float | None:
        """Return the number of an element, or None where the group has no such element."""
        text = self.element.findtext(name)
        if text is None or not text.strip():
            return None
        return number(self.path, f"photogroup {self.name}, {name}", text)

    def numbers(self, parent: str, names: tuple[str, ...]) -> list[float]:
        """Return numbers below an element, 0 for those that are not there."""
        return [self.number(f"{parent}/{name}") or 0.0 for name in names]

    def axes(self) -> FloatArray:
        """Return the matrix from camera axes to x right, y down, z forward."""
        name = (self.element.findtext("CameraOrientation") or "XRightYDown").strip()
        if name not in ORIENTATIONS:
            raise InputError(
                f"{self.path}: photogroup {self.name}: the camera orientation '{name}' is not one"
                f" of {', '.join(ORIENTATIONS)}."
            )
        x, y = ORIENTATIONS[name]
        return np.column_stack([x, y, np.cross(x, y)])

    def pixel_size_mm(self) -> float | None:
        """Return the size of a pixel where the group tells it."""
        pixel, sensor = self.number("PixelSize"), self.number("SensorSize")
        if pixel is not None:
            return pixel if pixel > 0.0 else None
        largest = max(self.size())
        return sensor / largest if sensor is not None and sensor > 0.0 < largest else None

    def size(self) -> list[float]:
        """Return width and height in pixels, 0 where they are not there."""
        return self.numbers("ImageDimensions", ("Width", "Height"))

    def lens(self) -> Lens | None:
        """Return the lens, or None where the group lacks frame or focal length.

        Raises
        ------
        InputError
            If it is of a kind that is not known.
        """
        kind = (self.element.findtext("CameraModelType") or "Perspective").strip()
        if kind not in ("Perspective", "Fisheye"):
            raise InputError(
                f"{self.path}: photogroup {self.name}: the camera model {kind} is not supported;"
                " export Perspective or Fisheye photos."
            )
        self._refuse_other_distortions()
        has_matrix = kind == "Fisheye" and self.element.find("FisheyeFocalMatrix") is not None
        focal = self._focal_px()
        if not min(self.size()) > 0.0 or (focal is None and not has_matrix):
            return None
        lens = self._perspective(focal or 0.0) if kind == "Perspective" else self._fisheye(focal)
        return checks.lens(self.path, f"of photogroup {self.name}", lens)

    def _refuse_other_distortions(self) -> None:
        for child in self.element:
            tag = str(child.tag)
            if "Distortion" in tag and tag not in ("Distortion", "FisheyeDistortion"):
                raise InputError(
                    f"{self.path}: photogroup {self.name}: the distortion {tag} is not supported;"
                    " export BlocksExchange 3.2 or older, or undistorted photos."
                )

    def _focal_px(self) -> float | None:
        focal_px, focal_mm = self.number("FocalLengthPixels"), self.number("FocalLength")
        pixel = self.pixel_size_mm()
        if focal_px is None and focal_mm is not None and pixel is not None:
            return focal_mm / pixel
        return focal_px

    def principal_point(self) -> tuple[float, float]:
        """Return the principal point in pixels from the corner; the centre where none is given."""
        x, y = self.number("PrincipalPoint/x"), self.number("PrincipalPoint/y")
        if x is not None and y is not None:
            return x + FIRST_PIXEL, y + FIRST_PIXEL
        pixel = self.pixel_size_mm()
        offset = np.zeros(2)
        if pixel is not None:
            mm = np.array(self.numbers("PrincipalPoint", ("xmm", "ymm")))
            offset = self.axes()[:2, :2] @ mm / pixel
        u, v = np.array(self.size()) / 2.0 + offset
        return float(u), float(v)

    def _perspective(self, focal: float) -> Lens:
        aspect = self.number("AspectRatio")
        down = focal if aspect is None else focal * aspect
        width, height = self.size()
        u, v = self.principal_point()
        return Lens(
            focal=down,
            width=width,
            height=height,
            principal_x=u,
            principal_y=v,
            b1=focal - down,
            b2=self.number("Skew") or 0.0,
            radial=tuple(self.numbers("Distortion", ("K1", "K2", "K3"))),
            tangential=tuple(self.numbers("Distortion", ("P1", "P2"))),
            pixel_size_mm=self.pixel_size_mm(),
            sensor=self.name,
        )

    def _fisheye(self, focal: float | None) -> Lens:
        m00, m01, m10, m11 = self.numbers("FisheyeFocalMatrix", ("M_00", "M_01", "M_10", "M_11"))
        if self.element.find("FisheyeFocalMatrix") is None and focal is not None:
            m00 = m11 = math.pi / 2.0 * focal
        shape = [0.0, 1.0, 0.0, 0.0, 0.0]
        if self.element.find("FisheyeDistortion") is not None:
            shape = self.numbers("FisheyeDistortion", ("P0", "P1", "P2", "P3", "P4"))
        width, height = self.size()
        u, v = self.principal_point()
        return Lens(
            focal=m11,
            width=width,
            height=height,
            principal_x=u,
            principal_y=v,
            b1=m00 - m11,
            b2=m01,
            b3=m10,
            projection="polynomial",
            shape=tuple(shape),
            pixel_size_mm=self.pixel_size_mm(),
            sensor=self.name,
        )
