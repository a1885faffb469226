"""One step over many files as over one cloud: in processes here, or on a cluster.

What a step must know of the whole cloud it learns once, here; then each file is a task: it applies
the step, writes its output, and records what it counted beside it, in the folder `RECORDS`. A
second call skips the files that have a record of the same work.
"""

from __future__ import annotations

import json
import pickle
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

from pcfix import version
from pcfix.errors import InputError, PcfixError, PcfixWarning, SettingError
from pcfix.flow.cluster import Run, in_processes, on_cluster
from pcfix.flow.record import belonging
from pcfix.flow.runner import FileTask, Progress, Step, check_cloud, check_summary, write_summary
from pcfix.io.files import file_state, read_counted, write_counted
from pcfix.io.tiles import BrokenTileError, Tiles, check_one_file
from pcfix.io.vectors import LAYER_MARK
from pcfix.kernels import threads
from pcfix.options.declare import options_of
from pcfix.sums import Counted

RECORDS = ".pcfix"
HOW = ("overwrite", "jobs", "scheduler", "summary")
"""Options on which no output depends."""
POINTS_A_PROCESS = 500_000
"""These take about as long as another process takes to start."""


class TileStep(Step, Protocol):
    """A step that can be sent to another process, which sends back what it counted."""

    def begin(self, first_row: int) -> None:
        """Forget what was counted; the next point is this row of the whole cloud."""

    def counted(self) -> Counted:
        """Return what was counted."""

    def add_counted(self, counted: Counted) -> None:
        """Add what another process counted."""


@dataclass(frozen=True)
class Tile:
    """A file to process, and its output.

    Attributes
    ----------
    first_row : int
        Of the whole cloud.
    key : str
        Checksum of everything that the output depends on.
    pcfix : str
        The version that must process it.
    """

    source: Path
    target: Path
    points: int
    first_row: int
    key: str
    pcfix: str

    def __str__(self) -> str:
        return str(self.source)

    @property
    def record(self) -> Path:
        """The file with what was counted, written when the output is complete."""
        return self.target.parent / RECORDS / f"{self.target.name}.npz"

    @property
    def is_finished(self) -> bool:
        """Whether the output is there, of the same work."""
        return self.target.is_file() and read_counted(self.record)[0].get("key") == self.key


def do_tile(pickled: bytes, tile: Tile, jobs: int | None = None) -> str:
    """Apply a step to one file, record what it counted, and return the error, if there was one.

    This is what runs in a process here and on a worker of a cluster.
    """
    try:
        if tile.pcfix != version.__version__:
            raise InputError(
                "cluster.version",
                f"{tile.source}: this worker has pcfix {version.__version__}, not {tile.pcfix}."
                " Install that there.",
            )
        if tile.is_finished:  # by a worker that was lost before it could say so
            return ""
        step: TileStep = pickle.loads(pickled)
        step.begin(tile.first_row)
        with threads(jobs), warnings.catch_warnings():
            warnings.simplefilter("ignore", PcfixWarning)  # shown where the step was made
            step.run(FileTask(tile.source, tile.target, jobs=jobs, is_tile=True))
        write_counted(tile.record, {"key": tile.key}, step.counted())
    except PcfixError as error:
        return str(error)
    return ""


@dataclass
class TiledRun:
    """A command over many files.

    Parameters
    ----------
    name : str
        Of the command.
    tiles : Tiles
    folder : path
        Of the outputs, which have the names of the inputs.
    options : OptionSet
        With jobs, scheduler and overwrite.
    progress : callable, optional
        Called with (points done, points in all) after each file.
    """

    name: str
    tiles: Tiles
    folder: Path
    options: Any
    progress: Progress | None = None
    started: float = field(default_factory=perf_counter)

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return perf_counter() - self.started

    def run(self, make: Callable[[Tiles], Any], tell: Callable[[Any], Any]) -> Any:
        """Process all files that are not finished yet.

        Parameters
        ----------
        make : callable
            Returns the step for some tiles, with all that it learns of the whole cloud.
        tell : callable
            Makes the result of the command from the step, which has counted all files.

        Raises
        ------
        PcfixError
            With the list of the files that failed, once the others are finished, or if the step
            cannot be made or refuses the result.
        """
        check_one_file(self.tiles, self.options)
        self.check_folder()
        check_summary(self.options, self.tiles.paths)
        work = self._work()
        done = {tile for tile in work.values() if tile.is_finished}
        todo = [tile for tile in work.values() if tile not in done]
        for tile in todo if self.folder.exists() else ():
            check_cloud(tile.target, overwrite=self.options.overwrite, inputs=self.tiles.paths)
        with threads(self.options.jobs), self._machines(sum(one.points for one in todo)) as run:
            step, tiles = self._made(make)
            step.begin(0)
            try:
                (self.folder / RECORDS).mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(
                    "output.folder", f"{self.folder}: cannot be made ({error.strerror})."
                ) from error
            todo = [work[path] for path in tiles.paths if work[path] not in done]
            failed = list(tiles.broken.values())
            for tile, why in run(do_tile, pickle.dumps(step), todo):
                if why:
                    failed.append(why)
                else:
                    done.add(tile)
                if self.progress is not None:
                    self.progress(sum(one.points for one in done), sum(self.tiles.points))
            if done:
                # in the order of the files, so that no sum depends on which was first
                for tile in (tile for tile in work.values() if tile in done):
                    step.add_counted(read_counted(tile.record)[1])
                _finish(step, todo)
                result = tell(step)
                if hasattr(result, "as_dict"):
                    write_summary(self.options, result.as_dict())
        if failed:
            count = len(work) + len(self.tiles.broken)
            raise InputError(
                "tiles.failed",
                f"{self.tiles}: {len(failed)} of {count} files failed. The same command continues"
                " with them; if files have changed, add --overwrite.\n"
                + "\n".join(f"  {one}" for one in failed),
                failed=failed,
            )
        return result

    def check_folder(self) -> None:
        """Refuse a folder that has inputs, or lies in theirs."""
        folder, named = self.folder.resolve(), Path(self.tiles.name)
        for path in self.tiles.paths:
            if path.parent.resolve() == folder:
                raise SettingError(
                    "output.is_input",
                    f"{self.folder}: is the folder of the input {path.name}. Give another one.",
                    path=self.folder,
                )
        if named.is_dir() and folder.is_relative_to(named.resolve()):
            raise SettingError(
                "output.is_input",
                f"{self.folder}: is inside the folder of the inputs. Give one outside of it.",
                path=self.folder,
            )
        if self.folder.exists() and not self.folder.is_dir():
            raise SettingError(
                "output.folder",
                f"{self.folder}: is a file. Give a folder for the outputs.",
                path=self.folder,
            )

    def _work(self) -> dict[Path, Tile]:
        """Return a tile for each file, in their order."""
        paths = [*self.tiles.paths, *self.tiles.broken]
        asked = {
            one.name: _plain(getattr(self.options, one.name))
            for one in options_of(type(self.options))
            if one.name not in HOW
        }
        depends = [version.__version__, self.name, asked, [file_state(path) for path in paths]]
        key = sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()
        work, row = {}, 0
        for path, points in zip(self.tiles.paths, self.tiles.points, strict=True):
            target = self.folder.resolve() / path.name
            work[path] = Tile(path.resolve(), target, points, row, key, version.__version__)
            row += points
        return work

    def _made(self, make: Callable[[Tiles], Any]) -> tuple[Any, Tiles]:
        """Return the step, and the tiles that could be read for it."""
        tiles = self.tiles
        while True:
            try:
                return make(tiles), tiles
            except BrokenTileError as error:
                tiles = tiles.without(error.path, str(error))

    @contextmanager
    def _machines(self, points: int) -> Iterator[Run]:
        """Give the function that runs tasks with this number of points."""
        if self.options.scheduler is None:
            jobs = self.options.jobs
            yield partial(in_processes, jobs, jobs or 1 + points // POINTS_A_PROCESS)
        else:
            with on_cluster(self.options.scheduler) as run:
                yield run


def _finish(step: TileStep, new: list[Tile]) -> None:
    """Let a step check the result of all files; remove the new ones if it refuses them."""
    try:
        step.finish()
    except PcfixError:
        for tile in new:
            tile.record.unlink(missing_ok=True)
            tile.target.unlink(missing_ok=True)
        raise


def _plain(value: Any) -> Any:
    """Return an option as JSON holds it; of files their size and time."""
    if isinstance(value, str) or hasattr(value, "joinpath"):
        path = Path(str(value).partition(LAYER_MARK)[0])
        return [file_state(one) for one in belonging(path)] if path.exists() else str(value)
    if value is None or isinstance(value, int | float | tuple):
        return value
    return sha256(pickle.dumps(value)).hexdigest()
