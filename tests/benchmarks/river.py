"""The real river beside pyBathySfM: true over apparent depth, and where the two differ.

    python -m tests.benchmarks.river

Needs the folder ``river`` of the shared test data (environment variable PCFIX_SHARED). Depths
below 2 cm are left out: there the ratio is mostly rounding. "Dietrich" is the peer's formula
(the mean over cameras of h_a tan r / tan i), computed here over exactly the cameras that pcfix
used, so that its rows differ from pyBathySfM's only by the choice of cameras, and from pcfix's
only by the method.
"""

import warnings

import laspy
import numpy as np

import pcfix
from tests.utils.shared import needs

PEER_INDEX = 1.337
LEAST_DEPTH_M = 0.02


def main():
    folder, _ = needs("river")
    if not folder.exists():
        raise SystemExit(f"no {folder}; set PCFIX_SHARED")
    warnings.simplefilter("ignore", pcfix.PcfixWarning)
    cameras = pcfix.read_cameras(folder / "cameras.csv")
    cloud = laspy.read(folder / "points.las")
    xyz, surface = cloud.xyz, np.asarray(cloud.w_surf)
    reference = np.genfromtxt(folder / "ref_out.csv", delimiter=",", names=True)
    apparent = reference["h_a"]
    use = apparent > LEAST_DEPTH_M
    print(f"{use.sum():,} of {len(xyz):,} points, n = {PEER_INDEX}")
    columns = "".join(f"{name:>8}" for name in ("mean", "sd", "5 %", "50 %", "95 %"))
    print(f"{'true / apparent depth':<38}{columns}{'rays':>7}")
    show("pyBathySfM, all", reference["h"][use] / apparent[use], reference["n_cams"][use])
    show(
        "pyBathySfM, 35 degrees",
        reference["h_filt35"][use] / apparent[use],
        reference["n_cams35"][use],
    )
    for limit in (None, 35.0):
        name = "all" if limit is None else f"{limit:g} degrees"
        options = {"index": PEER_INDEX, "method": "snell", "max_angle": limit}
        dietrich, count = dietrich_mean(xyz, surface, cameras, limit)
        show(f"Dietrich, cameras of pcfix, {name}", dietrich[use] / apparent[use], count[use])
        ours = pcfix.correct_points(xyz, cameras, surface, **options)
        show(f"pcfix, {name}", ours.depth_m[use] / apparent[use], ours.ray_count[use])
        same = (
            ours.ray_count == (reference["n_cams"] if limit is None else reference["n_cams35"])
        ).mean()
        print(f"{'':<4}same number of cameras as pyBathySfM at {100 * same:.1f} % of the points")


def dietrich_mean(xyz, surface, cameras, limit_deg):
    """Return the mean of h_a tan r / tan i over the cameras whose frame holds the point."""
    apparent = surface - xyz[:, 2]
    total, count = np.zeros(len(xyz)), np.zeros(len(xyz))
    for centre, rotation, lens in zip(
        cameras.centres, cameras.rotations, cameras.lenses, strict=True
    ):
        x, y, z = rotation @ (xyz - centre).T
        u, v = lens.focal * x / z + lens.principal_x, lens.focal * y / z + lens.principal_y
        seen = (z > 0) & (u >= 0) & (u <= lens.width) & (v >= 0) & (v <= lens.height)
        r = np.arctan2(np.hypot(*(xyz - centre)[:, :2].T), centre[2] - xyz[:, 2])
        if limit_deg is not None:
            seen &= r <= np.radians(limit_deg)
        i = np.arcsin(np.sin(r) / PEER_INDEX)
        total += np.where(seen, apparent * np.tan(r) / np.tan(i), 0.0)
        count += seen
    return total / count, count


def show(name, ratio, rays):
    low, middle, high = np.percentile(ratio, [5, 50, 95])
    print(
        f"{name:<38}{ratio.mean():8.4f}{ratio.std():8.4f}{low:8.4f}{middle:8.4f}{high:8.4f}"
        f"{rays.mean():7.1f}"
    )


if __name__ == "__main__":
    main()
