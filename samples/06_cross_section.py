"""Plot a cross-section: water surface, input cloud, corrected cloud and LiDAR.

Run 01_correct.py first.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import pcfix

scene = Path(__file__).parent / "scene"
line = "410200,4650340,410320,4650340"  # x1,y1,x2,y2 in the cloud's coordinates
result = pcfix.compare_clouds("corrected.laz", scene / "lidar.laz", section=[line])
section = result.sections[0]
for name, heights in section.heights_m.items():
    plt.plot(section.distance_m, heights, label=name)
plt.xlabel("distance along the line (m)")
plt.ylabel("height (m)")
plt.legend()
plt.savefig("section.png", dpi=120)
print(f"section.png: {len(section.distance_m)} stations along {section.line.length_m:.0f} m")
