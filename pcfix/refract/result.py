"""What every method of correction returns."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from pcfix.model import BoolArray, FloatArray


class Intersection(NamedTuple):
    """The result for m submerged points; see `pcfix.Correction` for the meaning of each.

    The methods themselves leave `sigma_z_m` and `covariance_m2` open, but for `intersect`, whose
    `sigma_z_m` is that of the scatter of the rays; `pcfix.refract.methods.correct` fills both.
    """

    shift_m: FloatArray
    outcome: npt.NDArray[np.uint8]
    ray_count: npt.NDArray[np.int32]
    ray_miss_m: FloatArray
    sigma_z_m: FloatArray
    incidence_deg: FloatArray
    camera_used: BoolArray
    pairs_tested: int
    covariance_m2: FloatArray | None = None
