"""Compile kernels before they are needed: as an image is built, or after an installation."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeAlias

from pcfix.errors import SettingError
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.runner import Progress
from pcfix.io.scenes import write_scene
from pcfix.kept import kept_kernels, roots
from pcfix.options.handover import WarmUpOptions
from pcfix.options.scenes import BlockKind, CloudKind
from pcfix.simulate.scene import simulate_scene

Step: TypeAlias = Callable[[], object]

POINTS = 2000
"""Of each scene; fewer, and nothing is told of how a cloud was made."""

LEVEL_M = 0.37
SCENES: tuple[tuple[str, tuple[CloudKind, BlockKind]], ...] = (
    ("tracks", ("tracks", "nadir")),
    ("maps", ("depth-maps", "oblique")),
)
VIEWS = {"tracks": "fused.ply.vis", "maps": "dense.ply"}
CORRECTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("tracks", {}),
    ("maps", {}),
    *(("tracks", {"views": True, "views_are": kind}) for kind in ("tracks", "pairs")),
    ("maps", {"views": True, "views_are": "depth-maps"}),
    ("tracks", {"views": True, "method": "consistent", "exact": True}),
    ("tracks", {"method": "consistent", "camera_set": "all"}),
    *(
        ("tracks", {"method": "consistent", "camera_set": "mvs", "matcher": matcher})
        for matcher in ("depth-maps", "pairs")
    ),
    *(
        ("tracks", {"method": method, **views})
        for method in ("snell", "shan", "murase", "butler", "dietrich")
        for views in ({}, {"views": True})
    ),
    ("tracks", {"method": "snell", "camera_set": "mvs"}),
    ("tracks", {"method": "factor", "depth_factor": "auto"}),
)
"""Scene and options of each correction that is run."""


class WarmUp(NamedTuple):
    """What was compiled, in which time, and the folders where kernels are kept."""

    kernels: int
    seconds: float
    folders: tuple[Path, ...]

    def __str__(self) -> str:
        """Return what to say of it."""
        where = f"kept in {' and '.join(map(str, self.folders))}"
        if not self.kernels:
            return f"nothing was to be done: the kernels are {where} (seen in {self.seconds:.0f} s)"
        kernels = f"{self.kernels} kernel{'s' * (self.kernels > 1)}"
        return f"{kernels} compiled in {self.seconds:.0f} s, {where}"


def warm_up(options: WarmUpOptions, progress: Progress | None = None) -> WarmUp:
    """Compile the kernels that commands need, by running these on two small scenes.

    Parameters
    ----------
    options : WarmUpOptions
    progress : callable, optional
        Called with (steps done, steps in all).

    Raises
    ------
    SettingError
        If there is no folder in which kernels can be kept.
    """
    started, before = time.perf_counter(), kept_kernels()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of scenes that nobody asked for
        if not roots():
            raise SettingError(
                "Kernels cannot be kept: neither the folder of pcfix, nor the user's cache, nor"
                " that of temporary files can be written; set NUMBA_CACHE_DIR to one that can."
            )
        with TemporaryDirectory() as folder:
            _run(steps(options.commands, Path(folder)), progress)
    after = kept_kernels()
    used = {root for root in roots() for file, _ in after if file.is_relative_to(root)}
    seconds = time.perf_counter() - started
    return WarmUp(len(after - before), seconds, tuple(sorted(used)))


def steps(commands: tuple[str, ...], folder: Path) -> list[Step]:
    """Return what is run in a folder so that these commands find their kernels."""
    scenes: list[Step] = [partial(_make, folder / name, *kinds) for name, kinds in SCENES]
    first, out = folder / SCENES[0][0], folder / "out.laz"
    cloud = first / "cloud.laz"
    of_command: dict[str, list[Step]] = {
        "correct": [partial(_correct, folder / name, **given) for name, given in CORRECTIONS],
        "clean": [partial(clean_file, cloud, out, water=LEVEL_M, radius=1.0, overwrite=True)],
        "dsm": [
            partial(grid_dsm, cloud, folder / "out.tif", method=method, fill=fill, overwrite=True)
            for method, fill in (("mean", 2.0), ("idw", None), ("tin", None))
        ],
        "compare": [partial(compare_clouds, cloud, first / "lidar.laz", direction="both")],
    }
    return [*scenes, *(step for name in commands for step in of_command[name])]


def _make(folder: Path, cloud: CloudKind, block: BlockKind) -> None:
    scene = simulate_scene(POINTS, cloud=cloud, block=block, water=LEVEL_M)
    write_scene(scene, folder, overwrite=False)


def _correct(scene: Path, *, views: bool = False, **given: Any) -> None:
    correct_file(
        scene / "cloud.laz",
        scene.parent / "out.laz",
        cameras=scene / "cameras.csv",
        water=LEVEL_M,
        views=scene / VIEWS[scene.name] if views else None,
        overwrite=True,
        **given,
    )


def _run(todo: list[Step], progress: Progress | None) -> None:
    for done, step in enumerate(todo):
        if progress is not None:
            progress(done, len(todo))
        step()
