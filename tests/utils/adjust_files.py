"""A block that swallowed the water, as the files that its user has."""

from dataclasses import dataclass, replace
from pathlib import Path

from pcfix.io.cameras.colmap import write_colmap
from pcfix.model import FloatArray
from tests.utils.clouds import write_las
from tests.utils.tie_points import TieScene, simulate_tie_points
from tests.utils.unaware_blocks import Unaware, apparent_cloud, parted, unaware

EPSG = "EPSG:32633"
IMAGE_PX = 0.3
TIES = 400


@dataclass(frozen=True, eq=False)
class Files:
    """What stands in a folder, and what is true.

    model/, bare/ : COLMAP, with tie points and without.
    cloud.las, gnss.csv, gcps.csv, lens.csv
    truth : array, shape (n, 3), of the points of the cloud, row by row.
    """

    folder: Path
    data: Unaware
    truth: FloatArray

    @property
    def scene(self) -> TieScene:
        return self.data.scene

    @property
    def water(self) -> float:
        return self.scene.water.a


def write_block(folder: Path, points: int = 1600, **settings: object) -> Files:
    """Simulate a block, adjust it unaware of the water, and write what its user has."""
    given = {
        "area_m": (50, 40), "greatest_depth_m": 5, "image_noise": IMAGE_PX,
        "position_noise_m": 0.3, "attitude_noise_deg": 0.2,
    } | settings  # fmt: skip
    scene, others = parted(simulate_tie_points(points, **given), TIES)
    data = unaware(scene)
    cameras = replace(data.cameras, crs=EPSG)
    write_colmap(folder / "model", cameras, data.ties)
    write_colmap(folder / "bare", cameras)
    write_las(folder / "cloud.las", apparent_cloud(data, others))
    positions = scene.cameras.gnss
    write_gnss(folder / "gnss.csv", scene.cameras.labels, positions.xyz, positions.sigma_m)
    write_gcps(folder / "gcps.csv", scene)
    lens = scene.true_cameras.lenses[0]
    (folder / "lens.csv").write_text(
        f"focal_px,width_px,height_px,cx,cy\n{lens.focal!r},{lens.width:g},{lens.height:g},"
        f"{lens.principal_x!r},{lens.principal_y!r}\n"
    )
    return Files(folder, data, others.truth)


def write_gnss(path: Path, labels: tuple[str, ...], xyz: FloatArray, sigma: FloatArray) -> None:
    rows = [
        ",".join([label, *(f"{value:.4f}" for value in (*place, *spread))])
        for label, place, spread in zip(labels, xyz, sigma, strict=True)
    ]
    path.write_text("\n".join(["image,x,y,z,sx,sy,sz", *rows]) + "\n")


def write_gcps(
    path: Path, scene: TieScene, *, wet: bool = True, names: tuple[str, ...] | None = None
) -> None:
    """Write surveyed points; without the column under_water, or with other names, as asked."""
    control = scene.control
    names = control.names if names is None else names
    rows = [f"# CRS: {EPSG}", "name,x,y,z,image,u,v,role" + (",under_water" if wet else "")]
    for point, camera, (u, v) in zip(control.point, control.camera, control.image_xy, strict=True):
        x, y, z = control.xyz[point]
        role = "check" if control.is_check[point] else "control"
        tail = f",{'yes' if control.under_water[point] else 'no'}" if wet else ""
        label = scene.cameras.labels[camera]
        rows.append(f"{names[point]},{x:.4f},{y:.4f},{z:.4f},{label},{u:.3f},{v:.3f},{role}{tail}")
    path.write_text("\n".join(rows) + "\n")
