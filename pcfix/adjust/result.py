"""What an adjustment found, ready for files, reports and further work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from pcfix.adjust.block import Block, Unknowns
    from pcfix.adjust.precision import Precision
    from pcfix.adjust.problem import LogRow
    from pcfix.model import BoolArray, Cameras, FloatArray, WaterSurface

Source = Literal["tie points", "cloud"]
Role = Literal["control", "check"]


@dataclass(frozen=True)
class ControlRow:
    """A surveyed point: adjusted minus surveyed in metres, and its residuals in the images."""

    name: str
    role: Role
    dx_m: float
    dy_m: float
    dz_m: float
    rms_px: float
    images: int


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A block after its adjustment.

    Attributes
    ----------
    block : Block
        What went in; its cameras are those before.
    unknowns : Unknowns
        What was free.
    cameras : Cameras
        Adjusted, in the same order and frame.
    water : WaterSurface or None
    refractive_index : float
    xyz : array, shape (m, 3)
        Adjusted true points, metres.
    residual_px : array, shape (o, 2)
        Measured minus computed; NaN where a camera does not image its point.
    used : array of bool, shape (o,)
        Observations that were not left out as outliers.
    is_wet : array of bool, shape (m,)
        Points that lie below the water.
    sigma0 : float
        A-posteriori standard deviation of unit weight.
    redundancy : int
        Observations, those of the unknowns included, minus unknowns.
    rounds : list of LogRow
    source : {"tie points", "cloud"}
        What the observations are: measured, or images of the apparent cloud.
    engine : str
    precision : Precision or None
    gnss_residual_m : array, shape (k, 3)
        Adjusted projection centres minus GNSS positions; NaN where there is none.
    control : list of ControlRow
    notes : list of str
        What was decided and what a user should know.
    """

    block: Block
    unknowns: Unknowns
    cameras: Cameras
    water: WaterSurface | None
    refractive_index: float
    xyz: FloatArray
    residual_px: FloatArray
    used: BoolArray
    is_wet: BoolArray
    sigma0: float
    redundancy: int
    rounds: list[LogRow]
    source: Source
    engine: str
    precision: Precision | None
    gnss_residual_m: FloatArray
    control: list[ControlRow]
    notes: list[str]

    def rms_px(self, points: BoolArray) -> float | None:
        """Return the root mean square residual of the used observations of some points."""
        r = self.residual_px[self.used & points[self.block.owner]]
        return float(np.sqrt(np.nanmean(r * r))) if len(r) else None

    def rms_m(self, points: BoolArray) -> float | None:
        """Return the same on the ground: residuals by distance over focal length."""
        rows = self.used & points[self.block.owner]
        if not rows.any():
            return None
        camera = self.block.camera[rows]
        away = self.xyz[self.block.owner[rows]] - self.cameras.centres[camera]
        focal = np.array([lens.focal for lens in self.cameras.lenses or ()])[camera]
        metres = self.residual_px[rows] * (np.linalg.norm(away, axis=1) / focal)[:, None]
        return float(np.sqrt(np.nanmean(metres * metres)))
