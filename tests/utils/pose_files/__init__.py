"""Write one block of cameras as each photogrammetry package would.

Nothing here comes from the readers: the conventions are written a second time, from the formats'
definitions, with numpy, scipy and pyproj alone. Every writer takes a folder and a `Block` and
returns a `PoseFile`. Numbers are written in full, so that what a reader gives back differs only
by what is wrong.
"""

from tests.utils.pose_files import mapping, metashape, opensfm, opf, sparse, tables

WRITERS = {
    "Metashape XML, geocentric": metashape.metashape_georeferenced,
    "Metashape XML, local": metashape.metashape_local,
    "Metashape omega-phi-kappa": metashape.metashape_omega_phi_kappa,
    "Metashape reference table": metashape.metashape_reference,
    "Pix4D params": mapping.pix4d,
    "OPF": opf.opf,
    "OpenSfM": opensfm.opensfm,
    "ODM shots.geojson": opensfm.odm_shots,
    "ODM reconstruction": opensfm.odm_reconstruction,
    "ODM up to 2020": opensfm.odm_topocentric,
    "COLMAP text": sparse.colmap_text,
    "COLMAP binary": sparse.colmap_binary,
    "MicMac": sparse.micmac,
    "Bundler": sparse.bundler,
    "VisualSFM": sparse.visual_sfm,
    "BlocksExchange": mapping.blocks_exchange,
    "BlocksExchange, ENU": mapping.blocks_exchange_enu,
    "RealityCapture XMP": mapping.reality_capture,
    "table, yaw-pitch-roll": tables.table_yaw_pitch_roll,
    "table, aircraft angles": tables.table_aircraft,
    "table, omega-phi-kappa": tables.table_omega_phi_kappa,
    "table, quaternions": tables.table_quaternion,
    "table, matrices": tables.table_matrix,
}
