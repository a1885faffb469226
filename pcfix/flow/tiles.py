"""One step over many files as over one cloud: in processes here, or on a cluster.

What a step must know of the whole cloud it learns once, here; then each file is a task of its own,
which takes the step, writes its output, and returns what it counted. Beside each output, in the
folder `RECORDS`, stands what was counted and of what it was made, so that a second call goes on.
"""

from __future__ import annotations

import json
import pickle
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from itertools import compress
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

from pcfix import version
from pcfix.errors import InputError, PcfixError, PcfixWarning, SettingError
from pcfix.flow.cluster import Run, in_processes, on_cluster
from pcfix.flow.runner import FileTask, Progress, Step, check_cloud, check_summary, write_summary
from pcfix.io.files import digest_of, read_counted, write_counted
from pcfix.io.tiles import BrokenTileError, Tiles, check_one_file
from pcfix.io.vectors import LAYER_MARK
from pcfix.kernels import threads
from pcfix.options.declare import options_of
from pcfix.sums import Counted

RECORDS = ".pcfix"
HOW = ("overwrite", "jobs", "scheduler", "summary")
"""Options on which no output depends."""
POINTS_A_PROCESS = 500_000
"""So many take about as long as another process takes to begin."""


class TileStep(Step, Protocol):
    """A step that can be taken to another process, and back as what it counted."""

    def begin(self, first_row: int) -> None:
        """Forget what was counted; the next point is this row of the whole cloud."""

    def run(self, task: FileTask) -> None:
        """Take a file through."""

    def counted(self) -> Counted:
        """Return what was counted."""

    def add_counted(self, counted: Counted) -> None:
        """Count what another process did."""


@dataclass(frozen=True)
class Tile:
    """A file to be worked on, wherever that is, and what it becomes.

    Attributes
    ----------
    first_row : int
        Of the whole cloud.
    key : str
        Checksum of all that the output depends on.
    pcfix : str
        The version that it is to be made with.
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
        """Where it is written that the output is finished."""
        return self.target.parent / RECORDS / f"{self.target.name}.npz"

    @property
    def is_finished(self) -> bool:
        """Whether the output is there, as it was left, and made of the same."""
        note, _ = read_counted(self.record)
        there = note.get("key") == self.key and self.target.is_file()
        return there and note["output"] == digest_of(self.target)

    @property
    def is_begun(self) -> bool:
        """Whether an output that is there is ours, of a call that came no further."""
        note, _ = read_counted(self.record)
        return note.get("key") == self.key and not note["output"]


def do_tile(pickled: bytes, tile: Tile, jobs: int | None = None) -> str:
    """Take one file through a step, record what it counted, and return why that failed, if it did.

    This is what runs in a process here and on a worker of a cluster.
    """
    try:
        if tile.pcfix != version.__version__:
            raise InputError(
                f"{tile.source}: this worker has pcfix {version.__version__}, not {tile.pcfix};"
                " install that there."
            )
        if tile.is_finished:  # by a worker that was lost before it could say so
            return ""
        write_counted(tile.record, {"key": tile.key, "output": ""}, {})
        step: TileStep = pickle.loads(pickled)
        step.begin(tile.first_row)
        with threads(jobs), warnings.catch_warnings():
            warnings.simplefilter("ignore", PcfixWarning)  # said once, where the step was made
            step.run(FileTask(tile.source, tile.target, jobs=jobs, is_tile=True))
        note = {"key": tile.key, "output": digest_of(tile.target)}
        write_counted(tile.record, note, step.counted())
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
        """How long it has taken so far."""
        return perf_counter() - self.started

    def run(
        self,
        make: Callable[[Tiles], Any],
        tell: Callable[[Any], Any],
        kind: Callable[..., Any] | None = None,
    ) -> Any:
        """Work on all files that are not finished yet.

        Parameters
        ----------
        make : callable
            Returns the step for some tiles, with all that it learns of the whole cloud.
        tell : callable
            Makes the result of the command from the step, which has counted all files.
        kind : type, optional
            Of the result, a dataclass of plain values; where all was finished before it is read.

        Raises
        ------
        PcfixError
            With the list of the files that failed, once the others are finished, or if the step
            cannot be made or refuses the result.
        """
        check_one_file(self.tiles, self.options)
        self.check_folder()
        check_summary(self.options, self.tiles.paths)
        key = self._key()
        work = self._work(key)
        with ThreadPoolExecutor() as pool:
            is_finished = pool.map(lambda tile: tile.is_finished, work.values())
            done = set(compress(work.values(), is_finished))
        result_file = self.folder / RECORDS / f"{self.name}.npz"
        note, _ = read_counted(result_file)
        if kind and len(done) == len(work) and not self.tiles.broken and note.get("key") == key:
            return self._told(kind(**note["result"]))
        todo = [tile for tile in work.values() if tile not in done]
        for tile in todo if self.folder.exists() else ():
            overwrite = self.options.overwrite or tile.is_begun
            check_cloud(tile.target, overwrite=overwrite, inputs=self.tiles.paths)
        points = sum(tile.points for tile in todo)
        with threads(self.options.jobs), self._machines(points) as machines:
            step, tiles = self._made(make)
            step.begin(0)
            self._make_folder()
            todo = [work[path] for path in tiles.paths if work[path] not in done]
            failed = list(tiles.broken.values())
            self._work_on(partial(machines, do_tile, pickle.dumps(step), todo), done, failed)
            if done:
                self._count(step, [tile for tile in work.values() if tile in done], todo)
                result = self._told(tell(step))
        if failed:
            raise InputError(
                f"{self.tiles}: {len(failed)} of {len(work) + len(self.tiles.broken)} files failed,"
                " the others are finished; the same command goes on, with --overwrite where files"
                " were changed, as each counts for all:\n" + "\n".join(f"  {one}" for one in failed)
            )
        if kind:
            write_counted(result_file, {"key": key, "result": vars(result)}, {})
        return result

    def _work_on(self, run: Run, done: set[Tile], failed: list[str]) -> None:
        """Run tasks, and add them to what is done, or why they failed."""
        total = sum(self.tiles.points)
        try:
            for tile, why in run():
                if why:
                    failed.append(why)
                else:
                    done.add(tile)
                if self.progress is not None:
                    self.progress(sum(one.points for one in done), total)
        except KeyboardInterrupt as stop:
            if stop.args:  # it is another signal
                raise
            raise KeyboardInterrupt(
                f"stopped; {len(done)} of {len(self.tiles.paths)} files are finished, the same"
                " command goes on."
            ) from None

    @staticmethod
    def _count(step: TileStep, work: list[Tile], new: list[Tile]) -> None:
        """Let the step count all files, and judge; what it refuses does not stay."""
        for tile in work:  # in their order, so that no sum depends on who was first
            step.add_counted(read_counted(tile.record)[1])
        try:
            step.finish()
        except PcfixError:
            for tile in new:
                tile.record.unlink(missing_ok=True)
                tile.target.unlink(missing_ok=True)
            raise

    def _told(self, result: Any) -> Any:
        if hasattr(result, "as_dict"):
            write_summary(self.options, result.as_dict())
        return result

    def check_folder(self) -> None:
        """Refuse a folder that has inputs, or lies in theirs."""
        folder, named = self.folder.resolve(), Path(self.tiles.name)
        for path in self.tiles.paths:
            if path.parent.resolve() == folder:
                raise SettingError(
                    f"{self.folder}: is the folder of {path.name}, an input; give another one."
                )
        if named.is_dir() and folder.is_relative_to(named.resolve()):
            raise SettingError(
                f"{self.folder}: lies in the folder of the inputs; give one outside of it."
            )
        if self.folder.exists() and not self.folder.is_dir():
            raise SettingError(
                f"{self.folder}: is a file; many files go to a folder, give the name of one."
            )

    def _make_folder(self) -> None:
        try:
            (self.folder / RECORDS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be made ({error.strerror}).") from error

    def _key(self) -> str:
        """Return the checksum of what all outputs depend on: options, other files, the tiles."""
        asked: dict[str, Any] = {"pcfix": version.__version__, "command": self.name}
        for one in options_of(type(self.options)):
            if one.name not in HOW:
                asked[one.name] = _plain(getattr(self.options, one.name))
        with ThreadPoolExecutor() as pool:
            paths = [*self.tiles.paths, *self.tiles.broken]
            asked["tiles"] = [
                [p.name, d] for p, d in zip(paths, pool.map(_digest, paths), strict=True)
            ]
        return sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()

    def _work(self, key: str) -> dict[Path, Tile]:
        """Return a tile for each file, in their order."""
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
                with threads(self.options.jobs):
                    return make(tiles), tiles
            except BrokenTileError as error:
                tiles = tiles.without(error.path, str(error))

    @contextmanager
    def _machines(self, points: int) -> Iterator[Run]:
        """Give what runs tasks of so many points."""
        if self.options.scheduler is None:
            jobs = self.options.jobs
            yield partial(in_processes, jobs, jobs or 1 + points // POINTS_A_PROCESS)
        else:
            with on_cluster(self.options.scheduler) as run:
                yield run


def _plain(value: Any) -> Any:
    """Return an option as JSON holds it; of files it is their content, and what lies beside them.

    A shapefile, a model of several files or a sensor is named by one of them.
    """
    if isinstance(value, str) or hasattr(value, "joinpath"):
        path = Path(str(value).partition(LAYER_MARK)[0])
        if not path.exists():
            return str(value)
        beside = path.resolve().parent.iterdir()
        files = [one for one in beside if one.stem == path.stem or one.name == "sensor.csv"]
        return [[one.name, digest_of(one)] for one in sorted(files)]
    if value is None or isinstance(value, int | float | tuple):
        return value
    return sha256(pickle.dumps(value)).hexdigest()


def _digest(path: Path) -> str:
    try:
        return digest_of(path)
    except OSError:  # it is among the broken ones
        return ""
