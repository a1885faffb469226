"""Mapping software with formats of its own: Pix4D, ContextCapture, RealityCapture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.utils.pose_files.block import PoseFile, omega_phi_kappa, topocentric_poses, words
from tests.utils.pose_files.lenses import write_images

if TYPE_CHECKING:
    from pathlib import Path

    from tests.utils.pose_files.block import Block

PIX4D_HEADER = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""


def pix4d(folder: Path, block: Block) -> PoseFile:
    folder = folder / "params"
    folder.mkdir()
    f, w, h = block.focal_px, block.width, block.height
    k = [words(row) for row in ((f, 0, w / 2), (0, f, h / 2), (0, 0, 1))]
    relative, absolute = PIX4D_HEADER, "imageName X Y Z Omega Phi Kappa\n"
    for i, (label, centre, rotation) in enumerate(block.poses()):
        lines = [f"{label} {w} {h}", *k, "0 0 0", "0 0", words(centre - block.origin)]
        relative += "\n".join([*lines, *(words(row) for row in rotation)]) + "\n"
        absolute += f"{label} {words(centre, omega_phi_kappa(block.rotations)[i])}\n"
    texts = {
        "calibrated_camera_parameters.txt": relative,
        "calibrated_external_camera_parameters.txt": absolute,
        "offset.xyz": "{:.3f} {:.3f} {:.3f}\n".format(*block.origin),
        "wkt.prj": block.crs.to_wkt("WKT1_GDAL"),
    }
    for name, text in texts.items():
        (folder / f"job_{name}").write_text(text)
    return PoseFile(folder, {})


def blocks_exchange(folder: Path, block: Block) -> PoseFile:
    path = folder / "block.xml"
    write_blocks_exchange(path, block, f"EPSG:{block.epsg}", block.poses())
    return PoseFile(path, {})


def blocks_exchange_enu(folder: Path, block: Block) -> PoseFile:
    """Write the frame of blocks without a CRS of their own: east, north, up at a place."""
    path = folder / "block.xml"
    lat, lon, height, *poses = topocentric_poses(block)
    named = zip(block.labels, *poses, strict=True)
    write_blocks_exchange(path, block, f"ENU:{lat!r},{lon!r},{height!r}", named)
    return PoseFile(path, {})


def write_blocks_exchange(path: Path, block: Block, srs: str, poses: Any) -> None:
    """Write a block; pixels are counted from the middle of the first."""
    photos = ""
    for i, (label, centre, rotation) in enumerate(poses):
        matrix = "".join(
            f"<M_{r}{c}>{float(rotation[r, c])!r}</M_{r}{c}>" for r in range(3) for c in range(3)
        )
        place = "".join(f"<{a}>{float(v)!r}</{a}>" for a, v in zip("xyz", centre, strict=True))
        photos += f"<Photo><Id>{i}</Id><ImagePath>D:\\flight\\{label}</ImagePath><Pose><Rotation>"
        photos += f"{matrix}</Rotation><Center>{place}</Center></Pose></Photo>"
    film = 36.0 / max(block.width, block.height)
    path.write_text(
        '<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="3.2">'
        "<SpatialReferenceSystems><SRS><Id>7</Id><Name>map</Name>"
        f"<Definition>{srs}</Definition></SRS></SpatialReferenceSystems>"
        "<Block><SRSId>7</SRSId><Photogroups><Photogroup><Name>one</Name><ImageDimensions>"
        f"<Width>{block.width}</Width><Height>{block.height}</Height></ImageDimensions>"
        f"<FocalLength>{block.focal_px * film!r}</FocalLength><SensorSize>36</SensorSize>"
        f"<PrincipalPoint><x>{(block.width - 1) / 2}</x><y>{(block.height - 1) / 2}</y>"
        f"</PrincipalPoint>{photos}</Photogroup></Photogroups></Block></BlocksExchange>"
    )


def reality_capture(folder: Path, block: Block) -> PoseFile:
    film = block.focal_px * 36.0 / max(block.width, block.height)
    for label, centre, rotation in block.poses():
        (folder / label).with_suffix(".xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
            ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
            ' xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3"'
            f' xcr:Coordinates="absolute" xcr:FocalLength35mm="{film!r}" xcr:Skew="0"'
            ' xcr:AspectRatio="1" xcr:PrincipalPointU="0" xcr:PrincipalPointV="0"'
            ' xcr:DistortionModel="brown3">'
            f"<xcr:Rotation>{words(rotation)}</xcr:Rotation>"
            f"<xcr:Position>{words(centre)}</xcr:Position>"
            "<xcr:DistortionCoeficients>0 0 0 0 0 0</xcr:DistortionCoeficients>"
            "</rdf:Description></rdf:RDF></x:xmpmeta>"
        )
    write_images(folder, block)
    return PoseFile(folder, {})
