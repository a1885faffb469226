"""What same_results.py runs, and the files that it makes for that.

A line of COMMANDS is one or more command lines of pcfix with && between them, run in a folder of
their own. In braces: ``shared`` and ``samples``, the data; ``inputs``, what `write_inputs` wrote;
or the name of an earlier command and a file that it left.
"""

import contextlib
import datetime
import json

import numpy as np

RIVER = "correct {shared}/river/points.las out.laz --cameras {shared}/river/cameras.csv"
IN_RIVER = f"{RIVER} --water dim:w_surf --summary summary.json"
TENTH = IN_RIVER.replace("{shared}/river/points.las", "{inputs}/river.las")
SCENE = (
    "{samples}/scene/cloud.laz out.laz --cameras {samples}/scene/cameras.csv --water 0.37"
    " --summary summary.json"
)
OFFSET = "--cameras-offset 319900,3842700,0"
BLOCK = (
    "correct {inputs}/a.las out.las --cameras {shared}/rendered_a/colmap --water 0.37"
    f" {OFFSET} --summary summary.json"
)
OBLIQUES = (
    "correct {inputs}/c.las out.las --cameras {shared}/rendered_c/colmap --water 0.37"
    " --cameras-offset 318700,3851200,0 --summary summary.json"
)
FREE = "{shared}/rendered_a_free"
KNOWN = f"out --water 0.37 {OFFSET} --gnss {FREE}/gnss.csv --jobs 1"
ADJUST = f"adjust {{shared}}/rendered_a/colmap {KNOWN}"  # 6,000 tie points, for 42,000 of the other
CLOUD = "--cloud {inputs}/free.las --views {inputs}/free.vis"
FREE_MODEL = f"{FREE}/sparse --cloud {{inputs}}/free.las --water 0.37 {OFFSET}"
PORT = (
    "correct {inputs}/port.las out.las --cameras {inputs}/port --sigma-waves 0"
    " --summary summary.json"
)
RUN = "run {samples}/scene/cloud.laz out --cameras {samples}/scene/cameras.csv --water 0.37"
DEPTHS = "--check-depths {inputs}/river_depths.csv"
SIMULATE = "simulate out --points 2000 --cameras 12 --area-m 60 40"
PDAL = "pdal pipeline --nostream {tree}/pipelines"
SCENE_IN = "--readers.las.filename={samples}/scene/cloud.laz"

METHODS = ("snell", "shan", "butler", "murase", "dietrich", "factor", f"regression {DEPTHS}")
OF_RIVER = {
    **{method.split()[0]: f"--method {method}" for method in METHODS},
    "consistent-all": "--method consistent --camera-set all",
    "max-angle": "--max-angle 35",
    "minimal": "--dimensions minimal",
    "dietrich-35": "--method dietrich --max-angle 35 --index 1.337",
    "factor-given": "--method factor --depth-factor 1.4 --dimensions none",
    "mvs": "--camera-set mvs",
    "occlusion": "--occlusion on",
    "no-occlusion": "--occlusion off --jobs 1",
    "sea": "--index sea",
    "salt": "--salinity 10 --temperature 25 --wavelength 0.6",
    "sigmas": (
        "--sigma-image 1 --sigma-level 0.05 --sigma-index 0.005 --sigma-waves 1"
        " --sigma-centre 0.03 --sigma-attitude 0.01"
    ),
    "withhold": "--max-angle 4",
    "mask": "--water-mask {inputs}/mask.geojson",
    "quiet": "--quiet",
}
OF_A_TENTH = {
    "consistent": "--method consistent",
    "consistent-pairs": "--method consistent --matcher pairs",
    "consistent-35": "--method consistent --max-angle 35",
    "snell-pairs": "--camera-set mvs --matcher pairs",
    "offset": "--cameras-offset 1,2,0.5 --sensor {shared}/river/sensor.csv",
    "crs": "--cameras-crs EPSG:27700 --angles yaw-pitch-roll",
    "no-angles": "--cameras {inputs}/bare.csv",
    "wrong-angles": "--angles omega-phi-kappa",
}
WATERS = {
    "level": "174.8",
    "plane": "plane:140.9572,1e-4,0",
    "raster": "{inputs}/water.tif",
    "obj": "{shared}/river/water_surface.obj",
    "ply": "{inputs}/water.ply",
    "csv": "{inputs}/shore.csv",
    "gpkg": "{inputs}/shore.gpkg",
    "geojson": "{inputs}/shore.geojson",
    "shore-level": "{inputs}/shore.csv --water-model level --water-crs EPSG:27700",
    "shore-plane": "{inputs}/shore.csv --water-model plane",
    "shore-along": "{inputs}/shore.csv --water-model along",
    "shore-river": "{inputs}/shore.csv --water-model river",
    "auto": "auto",
}
OF_SCENE = {
    "snell": "",
    "laz-jobs": "--jobs 1",
    "consistent": "--method consistent",
    "consistent-pairs": "--method consistent --matcher pairs",
    "connected": "--connected",
    "least-pool": "--connected --least-pool 5",
    "respect": "--respect-classes 2,5,6",
    "respect-0": "--respect-classes 0,1",
    "tide": "--tide {inputs}/tide.csv --image-times {inputs}/times.csv",
    "tide-consistent": (
        "--tide {inputs}/tide.csv --image-times {inputs}/times.csv --method consistent"
        " --camera-set all"
    ),
    "auto": "--water auto",
    "waves": "--sigma-waves 1 --method consistent --camera-set all",
}
OF_BLOCK = {
    "snell": "",
    "mvs": "--camera-set mvs",
    "consistent": "--method consistent",
    "consistent-pairs": "--method consistent --matcher pairs",
    "vis": "--views {inputs}/a.vis",
    "vis-consistent": "--views {inputs}/a.vis --method consistent",
    "vis-tracks": "--views {inputs}/a.vis --method consistent --views-are tracks",
    "vis-maps": "--views {inputs}/a.vis --method consistent --views-are depth-maps",
    "ply": "--views {shared}/rendered_a/dense.ply",
    "ply-consistent": "--views {shared}/rendered_a/dense.ply --method consistent",
    "ties": "--views {shared}/rendered_a/colmap --method consistent",
    "regression": f"--method regression --check-depths {FREE}/check_depths.csv",
    "auto": "--water auto",
    "metashape": "--cameras {shared}/rendered_a/cameras.xml --cameras-offset 0,0,0",
}
OF_PORT = {
    "flat": "--port flat:distance=0.02,thickness=0.008,glass=1.49",
    "flat-consistent": "--port flat:distance=0.02,thickness=0.008 --method consistent",
    "flat-views": (
        "--port flat:distance=0.02,nx=0.01 --method consistent --views {inputs}/port.vis"
    ),
    "dome": "--port dome:radius=0.1,thickness=0.005,glass=1.5,x=0,y=0,z=0.01",
    "dome-views": (
        "--port dome:radius=0.1,thickness=0.005,z=0.01 --method consistent"
        " --views {inputs}/port.vis --views-are tracks"
    ),
}
OF_ADJUST = {
    "gnss": "",
    "gcps": f"--gcps {FREE}/gcps.csv --free level --sigma-level 0.1",
    "held": "--lens-unknowns f --gnss-sigma 0.05",
    "fixed": "--poses fixed --sigma-index 0.01 --sigma-tilt 0.1",
    "free-datum": "--datum free --lens {inputs}/lens.csv",
    "not-told-apart": "--free level,tilt,index",
}
OF_OBLIQUES = {"default": "", "views": "--views {inputs}/c.vis", "snell": "--method snell"}
OF_PHOTOS = {"exact": "--dsm {dsm.block/out.tif}", "paper": "--mapping paper --dsm {inputs}/a.las"}
OF_PLAN = {
    "nadir": "--height 60 --depth 1,2,3,4,5",
    "obliques": "--height 40 --obliques 30 --overlap 0.7 --depth 3",
}
OF_CLEAN = {
    "default": "",
    "drop": "--drop --min-rays 8 --max-ray-miss 0.05 --max-incidence 40",
    "radius": "--radius 0.4 --radius-neighbours 2 --neighbours 8 --deviations 2",
    "bed": "--water 0.37 --bed-neighbours 16 --fences 1 --below 0.05 --floating 0.05",
    "little": "--no-statistical --no-weak --no-below --water 0.37",
    "nothing": "--no-statistical --no-weak --no-below --no-floating",
}
OF_DSM = {
    **{m: f"--method {m}" for m in ("mean", "median", "min", "max", "tin")},
    "bed": "--surface bed --fill 3",
}
SECTION = "--section 410200,4650340,410320,4650340 --sections 2 --corridor 2"
OF_COMPARE = {
    "cloud": "{samples}/scene/lidar.laz",
    "submerged": "{samples}/scene/lidar.laz --submerged --bin-width 2",
    "c2c": "{samples}/scene/lidar.laz --c2c-only",
    "sections": f"{{samples}}/scene/lidar.laz {SECTION} --neighbours 12 --max-gap 2",
    "m3c2": "{samples}/scene/lidar.laz --m3c2 --water 0.37",
    "both": "{samples}/scene/lidar.laz --direction both",
    "csv": "{inputs}/checks.csv",
    "tif": "{dsm.mean/out.tif}",
}
OF_LABEL = {
    "default": "--water 0.37",
    "connected": "--water plane:0.37,0,0 --connected --least-pool 20",
    "auto": "--water auto",
}
CAMERAS = (
    "blocksexchange/goodale_enu_one_photo/AT_one_photo.xml",
    "blocksexchange/paris_doc_example/Paris2012_one_photo.xml",
    "bundler/kermit/bundle.out",
    "bundler/mve_testerarm/synth_0.out",
    "colmap/ar_boxes/bin",
    "colmap/ar_boxes/txt",
    "colmap/wesley_dense",
    "csv/pybathysfm/BathySfM_SampleCameras.csv",
    "metashape/bitbyt3r_local93/cameras.xml",
    "metashape/dbat_camcal_psz/c4040z.psz",
    "metashape/easyidp_wheat_psx/wheat_tanashi.psx",
    "metashape/micasense_rig/markers_micasenses_rededge.xml",
    "metashape/uclm_sorolla/markers.xml",
    "metashape/uclm_sorolla/markers_25830-5782.xml",
    "metashape_opk/sfmrefract/eo/eo_009_nadiryawlock_opk.txt",
    "metashape_opk/sfmrefract/trajectory.txt",
    "micmac/li3ds",
    "nvm/testerarm_undistorted/reconstruction.nvm",
    "nvm/testerarm_undistorted/reconstruction.json",
    "odm/hectorsosa",
    "odm/orthority_odm",
    "odm/orthority_odm/odm_lla_rpy.csv",
    "odm/orthority_odm/odm_xyz_opk.csv",
    "odm/testerarm_sub0",
    "odm/testerarm_sub0/odm_report/shots.geojson",
    "opensfm/berlin",
    "opensfm/berlin/reconstruction.json",
    "pix4d/ca502_oblique5/params",
    "pix4d/easyidp_pix4d_origin",
    "pix4d/lod3_amsterdam",
    "pix4d/lod3_amsterdam/calibrated_external_camera_parameters.txt",
    "realitycapture/xmp_one_image",
)
BAD = {
    "no-cloud": "correct nowhere.las out.las --cameras {samples}/scene/cameras.csv --water 0",
    "no-cameras": "correct {samples}/scene/cloud.laz out.las --cameras nowhere.csv --water 0",
    "no-water": "correct {samples}/scene/cloud.laz out.las --cameras {samples}/scene/cameras.csv",
    "spec": f"correct {SCENE} --water nonsense",
    "plane": f"correct {SCENE} --water plane:1,2",
    "dimension": f"correct {SCENE} --water dim:w_surf",
    "too-high": f"correct {SCENE} --water 500",
    "dry": f"correct {SCENE} --water -300",
    "method": f"correct {SCENE} --method magic",
    "index": f"correct {SCENE} --index 2.4",
    "index-twice": f"correct {SCENE} --index 1.34 --salinity 30",
    "classes": f"correct {SCENE} --respect-classes a,b",
    "least-pool": f"correct {SCENE} --least-pool 5",
    "no-check-depths": f"correct {SCENE} --method regression",
    "tide-alone": f"correct {SCENE} --image-times {{inputs}}/times.csv",
    "suffix": "correct {samples}/scene/cloud.laz out.txt --cameras c.csv --water 0",
    "same-file": "restore {scene.snell/out.laz} {scene.snell/out.laz} --overwrite",
    "port-and-water": f"{PORT} --water 0 --port flat:distance=0.1",
    "port-spec": f"{PORT} --port flat:distance=-1",
    "other-place": f"{RIVER} --water 174.8 --cameras {{samples}}/scene/cameras.csv",
    "feet": f"{RIVER} --water 174.8 --cameras-crs EPSG:2263",
    "views": f"{BLOCK} --views {{shared}}/rendered_a_free/dense.vis",
    "not-corrected": "restore {samples}/scene/cloud.laz out.laz",
    "resolution": "dsm {samples}/scene/cloud.laz out.tif --resolution -1",
    "reference": "compare {samples}/scene/cloud.laz nowhere.las",
    "other-reference": "compare {samples}/scene/cloud.laz {shared}/river/points.las",
    "run-nothing": "run",
    "no-ties": "adjust {samples}/scene/cameras.csv out --water 0.37",
    "adjust-words": f"adjust {FREE}/sparse out --water 0.37 --free nonsense",
    "no-command": "corect",
    "no-option": f"correct {SCENE} --kamera x",
    "not-a-camera-file": "cameras {samples}/scene/scene.json",
    "exists": f"correct {SCENE} --quiet && correct {SCENE}",
}
API = "import inspect, pcfix\nfor name in sorted(pcfix.__all__):\n    thing = getattr(pcfix, name)"
API += """
    print(name, sorted(n for n in dir(thing) if n[0] != "_") if inspect.isclass(thing) else "")
    if inspect.isclass(thing) and issubclass(thing, Exception):
        print("   ", [base.__name__ for base in thing.__mro__])
    elif callable(thing) and name != "Outcome":
        for word in inspect.signature(thing).parameters.values():
            print("   ", word.replace(annotation=word.empty), word.kind.name)
"""
NAMES = "run correct adjust label clean dsm compare cameras water restore simulate demo"


def table() -> dict[str, str]:
    """Return the command lines by name, in an order in which each finds its files."""
    commands = {"help": "--help", "version": "--version", "api": f"python -c '{API}'"}

    def add(group, line, variants):
        commands.update({f"{group}.{name}": f"{line} {more}" for name, more in variants.items()})

    for name in NAMES.split():
        commands[f"help.{name}"] = f"{name} --help"
    add("river", IN_RIVER, OF_RIVER)
    add("tenth", TENTH, OF_A_TENTH)
    add("water", f"{RIVER} --summary summary.json --water", WATERS)
    of_cloud = "--cloud {shared}/river/points.las --summary summary.json"
    some = ("level", "csv", "gpkg", "shore-river", "auto", "obj", "raster")
    add("fit", f"water {of_cloud}", {name: WATERS[name] for name in some})
    commands["fit.scene"] = "water auto --cloud {samples}/scene/cloud.laz --summary summary.json"
    add("scene", f"correct {SCENE}", OF_SCENE)
    add("bad", "", BAD)
    add("block", BLOCK, OF_BLOCK)
    add("obliques", OBLIQUES, OF_OBLIQUES)
    for fusion in ("multi", "steepest"):
        matched = f"correct {{inputs}}/sgm_{fusion}.las out.las"
        commands[f"sgm.{fusion}"] = OBLIQUES.replace("correct {inputs}/c.las out.las", matched)
    add("port", PORT, OF_PORT)
    add("adjust", ADJUST, OF_ADJUST)
    commands["adjust.ties"] = f"adjust {FREE}/sparse {KNOWN}"
    cloud = f"adjust {FREE}/sparse {KNOWN} {CLOUD} --ties cloud"
    add("adjust", cloud, {"cloud": "", "cloud-gcps": f"--gcps {FREE}/gcps.csv"})
    add("clean", "clean {scene.snell/out.laz} out.laz --summary summary.json", OF_CLEAN)
    cleaned = "{clean.default/out.laz} out.tif --resolution 2 --summary summary.json"
    add("dsm", f"dsm {cleaned}", OF_DSM)
    compare = "compare {scene.snell/out.laz} --out-dir out --summary summary.json"
    add("compare", compare, OF_COMPARE)
    add("label", "label {samples}/scene/cloud.laz out.laz --summary summary.json", OF_LABEL)
    labelled = "{label.default/out.laz} out.las --water 0.37 --cameras {samples}/scene/cameras.csv"
    commands["label.respected"] = f"correct {labelled} --respect-classes 2 --summary summary.json"
    commands["restore"] = "restore {clean.default/out.laz} out.laz"
    commands["restore.river"] = "restore {river.sigmas/out.laz} out.las"
    commands["restore.minimal"] = "restore {river.minimal/out.laz} out.las"
    for path in CAMERAS:
        name = path.replace("/", "-")
        commands[f"cameras.{name}"] = f"cameras {{shared}}/cameras/{path} --summary summary.json"
    commands["cameras.scene"] = (
        "cameras {samples}/scene/cameras.csv --cloud {samples}/scene/cloud.laz --water 0.37"
        " --summary summary.json"
    )
    signs = f"--gnss {FREE}/gnss.csv --gcps {FREE}/gcps.csv --summary summary.json"
    commands["cameras.free"] = (
        f"cameras {FREE_MODEL} {signs} --reference {{shared}}/rendered_a/lidar.laz"
    )
    transferred = (
        f"correct {{inputs}}/free.las out.las --water 0.37 {OFFSET} --summary summary.json"
    )
    transferred += f" --cameras {{adjust.ties/out}}/colmap --adjusted-from {FREE}/sparse"
    views = "--views {inputs}/free.vis --method consistent"
    add("carried", transferred, {"snell": "", "views": views})
    tiles = "--cameras {samples}/scene/cameras.csv --water 0.37 --summary summary.json"
    commands["tiles.correct"] = f"correct {{inputs}}/tiles out {tiles}"
    commands["tiles.clean"] = "clean {tiles.correct/out} out --summary summary.json"
    commands["tiles.dsm"] = "dsm {tiles.correct/out} out.tif --resolution 2 --what depth"
    commands["tiles.restore"] = "restore {tiles.correct/out} out"
    commands["dsm.block"] = "dsm {block.ties/out.las} out.tif --resolution 0.5 --fill 5"
    photographs = f"--cameras {{shared}}/rendered_a/colmap {OFFSET} --water 0.37"
    add("photos", f"photos {{inputs}}/images out {photographs}", OF_PHOTOS)
    ortho = f"ortho {{inputs}}/images out.tif {photographs} --dsm {{dsm.block/out.tif}}"
    commands["ortho"] = f"{ortho} --resolution 0.2"
    commands["calm"] = "calm {inputs}/frames out.png --surface --depth 2 --gsd 0.02 --interval 0.2"
    add("plan", "plan --summary summary.json", OF_PLAN)
    shown = "--reference {samples}/scene/lidar.laz --cameras {samples}/scene/cameras.csv"
    commands["view"] = f"view {{scene.snell/out.laz}} {shown} --water 0.37 --image out.png"
    commands["qgis-plugin"] = "qgis-plugin out.zip"
    flight = "--block oblique --detection 0.9 --position-noise-m 0.03"
    kinds = {"tracks": "", "river": "--bed river", "oblique": flight}
    kinds["tilted"] = "--tilt-percent 0.2 --bed steps --seed 3 --lidar-per-m2 1"
    add("simulate", SIMULATE, kinds)
    reference = f"{RUN} --reference {{samples}}/scene/lidar.laz --resolution 2"
    commands["run.reference"] = reference
    commands["run.again"] = f"{RUN} --quiet && {RUN}"
    mended = f"run {{inputs}}/free.las out --cameras {FREE}/sparse --water 0.37 {OFFSET}"
    commands["run.adjust"] = f"{mended} --gnss {FREE}/gnss.csv --adjust yes --jobs 1"
    commands["demo"] = "demo out --points 4000"
    for number in ("01_correct", "02_compare_with_lidar", "04_many_tiles"):
        first = "python {samples}/01_correct.py && " if number.startswith("02") else ""
        commands[f"sample.{number}"] = f"{first}python {{samples}}/{number}.py"
    return commands


def pdal_table() -> dict[str, str]:
    """Return those that need the program pdal."""
    many = "--writers.las.filename=out.las --filters.python.pdalargs="
    args = {"cameras": "{samples}/scene/cameras.csv", "water": 0.37}
    more = {
        "options": {"max_angle": 30, "connected": True, "summary": "summary.json", "jobs": 1},
        "consistent": {"method": "consistent", "camera_set": "all", "dimensions": "minimal"},
        "sea": {"index": "sea", "sigma_waves": 1},
        "wrong": {"method": "magic"},
        "unknown": {"kamera": 1},
    }
    recipe = {name: f"{PDAL}/{name}.json" for name in ("correct", "label")}
    commands = {
        "pdal.correct": f"{recipe['correct']} {SCENE_IN} {many}'{json.dumps(args)}'",
        "pdal.label": f"{recipe['label']} {SCENE_IN} --writers.las.filename=out.las",
        "pdal.clean": (
            f"{PDAL}/correct_clean_dsm.json {SCENE_IN} --writers.las.filename=out.las"
            f" --filters.python.pdalargs='{json.dumps(args)}'"
        ),
        "pdal.metadata": (
            f"{recipe['correct']} {SCENE_IN} {many}'{json.dumps(args)}' --metadata meta.json"
        ),
    }
    for name, options in more.items():
        words = json.dumps({**args, **options})
        commands[f"pdal.{name}"] = f"{recipe['correct']} {SCENE_IN} {many}'{words}'"
    return commands


def write_inputs(folder, shared, samples):
    """Write the made-up and the thinned files; the same bytes of data every time."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(5)
    river(folder, shared / "river", rng)
    thin(shared / "river/points.las", folder / "river.las", 10)
    blocks = ("a", "rendered_a", 12), ("c", "rendered_c", 12), ("free", "rendered_a_free", 10)
    for name, data, step in blocks:
        thin(shared / data / "cloud.las", folder / f"{name}.las", step)
        thin_views(shared / data / "dense.vis", folder / f"{name}.vis", step)
    for fusion in ("multi", "steepest"):
        thin(shared / f"rendered_c_sgm/{fusion}.laz", folder / f"sgm_{fusion}.las", 12)
    tiles(samples / "scene/cloud.laz", folder / "tiles")
    photographs(shared / "rendered_a/images", folder / "images")
    frames(folder / "frames", rng)
    port(folder, rng)
    labels = [row.split(",")[0] for row in lines(samples / "scene/cameras.csv")]
    times = [f"{label},2024-05-01T10:{at:02d}:00Z" for at, label in enumerate(labels)]
    write(folder / "times.csv", "label,time", times)
    tide = [f"2024-05-01T{hour:02d}:00:00Z,{level}" for hour, level in ((9, 0.3), (10, 0.37))]
    write(folder / "lens.csv", "focal_px,width_px,height_px", ["1500,1600,1200"])
    write(folder / "tide.csv", "time,level_m", [*tide, "2024-05-01T11:00:00Z,0.5"])
    import laspy

    checks = laspy.read(samples / "scene/lidar.laz").xyz[::50]
    write(folder / "checks.csv", "x,y,z", [f"{x:.3f},{y:.3f},{z:.3f}" for x, y, z in checks])


def river(folder, data, rng):
    """Water surfaces of many kinds, a mask, check depths and bare camera positions."""
    points = np.loadtxt(data / "points.csv", delimiter=",", skiprows=1)[::300]
    depth = 1.4 * (points[:, 3] - points[:, 2]) + rng.normal(0, 0.005, len(points))
    rows = np.column_stack([points[:, :2], depth])[depth > 0]
    write(folder / "river_depths.csv", "x,y,depth", [f"{x},{y},{d:.4f}" for x, y, d in rows])
    bare = [",".join(row.split(",")[:4]) for row in lines(data / "cameras.csv")]
    write(folder / "bare.csv", "label,x,y,z", bare)
    x = np.tile(np.linspace(338416, 338440, 25), 2)
    y = np.repeat([272917.0, 272930.0], 25)
    z = 174.80 + 0.0004 * (x - x[0]) + rng.normal(0, 0.005, 50) + 0.5 * (np.arange(50) % 9 == 4)
    xyz = np.column_stack([x, y, z]).round(4).tolist()
    write(folder / "shore.csv", "x,y,z", [f"{a},{b},{c}" for a, b, c in xyz])
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::27700"}}
    to_geojson(folder / "shore.geojson", [{"type": "Point", "coordinates": p} for p in xyz], crs)
    box, hole = square(338416, 272916, 16), square(338420, 272920, 4)
    to_geojson(folder / "mask.geojson", [{"type": "Polygon", "coordinates": [box, hole]}], crs)
    mesh = [row.split() for row in (data / "water_surface.obj").read_text().splitlines()]
    corners = [[float(one) for one in row[1:4]] for row in mesh if row[:1] == ["v"]]
    faces = [[int(c.split("/")[0]) - 1 for c in row[1:]] for row in mesh if row[:1] == ["f"]]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(corners)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = np.zeros(len(faces), [("count", "u1"), ("corner", "<i4", 3)])
    rows["count"], rows["corner"] = 3, faces
    data = "\n".join([*head, ""]).encode() + np.array(corners, "<f8").tobytes() + rows.tobytes()
    (folder / "water.ply").write_bytes(data)
    import rasterio

    heights = np.tile(174.8 + 0.0004 * np.arange(36), (25, 1)).astype("float32")
    to_map = rasterio.Affine(1, 0, 338410, 0, -1, 272938)
    shape = {"height": 25, "width": 36, "count": 1, "dtype": "float32", "driver": "GTiff"}
    with rasterio.open(
        folder / "water.tif", "w", transform=to_map, crs="EPSG:27700", **shape
    ) as sink:
        sink.write(heights, 1)
    with contextlib.suppress(ImportError):  # as in an environment with PDAL
        import shapely
        from pyogrio.raw import write as write_vectors

        places = shapely.to_wkb(shapely.points(xyz))
        of = {"geometry_type": "Point Z", "crs": "EPSG:27700", "driver": "GPKG"}
        write_vectors(folder / "shore.gpkg", places, field_data=[], fields=[], **of)


def square(x, y, side):
    return [[x, y], [x + side, y], [x + side, y + side], [x, y + side], [x, y]]


def port(folder, rng):
    """A bed 3 m below twelve images that look straight down, a COLMAP model and a view list."""
    import laspy

    east, north = np.meshgrid(np.arange(4) * 0.5, np.arange(3) * 0.5)
    centres = np.column_stack([east.ravel(), north.ravel(), np.zeros(12)])
    xy = rng.uniform([-0.5, -0.5], [2.0, 1.5], (2000, 2))
    xyz = np.column_stack([xy, rng.normal(-3, 0.2, 2000)])
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales, las.header.creation_date = [1e-4] * 3, datetime.date(2024, 5, 1)
    las.xyz = xyz
    las.write(folder / "port.las")
    model = folder / "port"
    model.mkdir()
    write(model / "cameras.txt", "# cameras", ["1 PINHOLE 2000 1500 1500 1500 1000 750"])
    poses = [f"{k} 0 1 0 0 {-x} {y} {z} 1 P{k}.jpg\n" for k, (x, y, z) in enumerate(centres, 1)]
    write(model / "images.txt", "# images", poses)
    write(model / "points3D.txt", "# points", [])
    off = np.abs(xyz[:, None, :2] - centres[None, :, :2]) / -xyz[:, None, 2:]
    views = [np.flatnonzero(row) for row in (off < [0.6, 0.45]).all(axis=2)]
    write_views(folder / "port.vis", views)


def thin(source, target, step):
    import laspy

    las = laspy.read(source)
    las.points = las.points[np.arange(0, len(las), step)]
    las.write(target)


def tiles(source, folder):
    """Split a cloud into three tiles by X."""
    import laspy

    folder.mkdir()
    las = laspy.read(source)
    tile = np.searchsorted(np.quantile(las.x, [0.3, 0.6]), np.asarray(las.x))
    for number in range(3):
        part = laspy.LasData(las.header, las.points[tile == number])
        part.write(folder / f"tile_{number}.laz")


def photographs(source, folder):
    """Take every eighth photograph."""
    folder.mkdir()
    for path in sorted(source.glob("*.JPG"))[::8]:
        (folder / path.name).symlink_to(path)


def frames(folder, rng):
    """Draw a bed of smooth random texture that waves shift a little differently in each frame."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    try:
        from PIL import Image
    except ImportError:
        return
    folder.mkdir()
    bed = gaussian_filter(rng.normal(size=(240, 320)), 1.5)
    bed = 128 + 40 * bed / bed.std()
    rows, columns = np.mgrid[:240, :320].astype(float)
    for number in range(8):
        phase = rng.uniform(0, 2 * np.pi, 2)
        shifted = [rows + 1.5 * np.sin(columns / 20 + phase[0])]
        shifted += [columns + 1.5 * np.sin(rows / 25 + phase[1])]
        image = map_coordinates(bed, shifted, order=1, mode="reflect").clip(0, 255)
        Image.fromarray(image.astype("uint8")).convert("RGB").save(folder / f"f{number:02d}.png")


def thin_views(source, target, step):
    """Keep the lists of every so many-th point of a COLMAP fused.ply.vis."""
    words = np.fromfile(source, "<u4")
    at, views = 2, []
    while at < len(words):
        views.append(words[at + 1 : at + 1 + words[at]])
        at += 1 + int(words[at])
    write_views(target, views[::step])


def write_views(path, views):
    rows = [np.concatenate([[len(row)], row]).astype("<u4") for row in views]
    path.write_bytes(np.uint64(len(views)).tobytes() + np.concatenate(rows).tobytes())


def to_geojson(path, geometries, crs):
    features = [{"type": "Feature", "properties": {}, "geometry": one} for one in geometries]
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))


def lines(path):
    return path.read_text().splitlines()[1:]


def write(path, head, rows):
    path.write_text("\n".join([head, *rows]) + "\n")
