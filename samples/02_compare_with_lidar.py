"""Compare a corrected cloud with LiDAR: errors before and after the correction.

Run 01_correct.py first. The errors before are known, because the corrected cloud stores its shifts.
"""

from pathlib import Path

import pcfix

scene = Path(__file__).parent / "scene"
result = pcfix.compare_clouds("corrected.laz", scene / "lidar.laz", submerged=True)
for name, side in (("uncorrected", result.vertical.before), ("corrected", result.vertical.after)):
    s = side.statistics
    print(f"{name:<12} bias {s.mean_m:+.3f} m, RMSE {s.rmse_m:.3f} m, NMAD {s.nmad_m:.3f} m")
for one in result.depth_bins:
    print(f"{one.from_m:4.0f} to {one.to_m:2.0f} m deep: RMSE {one.after.rmse_m:.3f} m")
