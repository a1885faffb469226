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
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

from pcfix import version
from pcfix.errors import InputError, PcfixError, PcfixWarning, SettingError
from pcfix.flow.cluster import in_processes, on_cluster
from pcfix.flow.runner import FileTask, Progress, Step, check_cloud, check_summary
from pcfix.io.files import digest_of, path_of, read_counted, write_counted
from pcfix.io.tiles import BrokenTileError, Tiles, output_name
from pcfix.kernels import threads
from pcfix.options.declare import File, OptionSet, options_of
from pcfix.sums import Counted

RECORDS = ".pcfix"
HOW = ("overwrite", "jobs", "scheduler", "summary")
"""Options on which no output depends."""


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

    def finished(self) -> Counted | None:
        """Return what was counted, if the output is there, whole, and of the same key."""
        note, counted = read_counted(self.record)
        if note.get("key") != self.key or not self.target.is_file():
            return None
        return counted if note["output"] == digest_of(self.target) else None


def do_tile(pickled: bytes, tile: Tile, jobs: int | None = None) -> Counted | str:
    """Take one file through a step and return what was counted, or why it failed.

    This is what runs in a process here and on a worker of a cluster.
    """
    try:
        if tile.pcfix != version.__version__:
            raise InputError(
                f"{tile.source}: this worker has pcfix {version.__version__}, not {tile.pcfix};"
                " install that there."
            )
        step: TileStep = pickle.loads(pickled)
        step.begin(tile.first_row)
        for left in tile.target.parent.glob(f".{tile.target.stem}.*.part{tile.target.suffix}"):
            left.unlink(missing_ok=True)  # of a worker that was killed
        with threads(jobs), warnings.catch_warnings():
            warnings.simplefilter("ignore", PcfixWarning)  # said once, where the step was made
            step.run(FileTask(tile.source, tile.target, jobs=jobs, is_tile=True))
        found = step.counted()
        note = {"key": tile.key, "pcfix": tile.pcfix, "output": digest_of(tile.target)}
        write_counted(tile.record, note, found)
    except PcfixError as error:
        return str(error)
    return found


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
        self._check_folder()
        check_summary(self.options, self.tiles.paths)
        whole = self._key()
        work = self._work(whole)
        found = {tile: tile.finished() for tile in work}
        done = {tile: counted for tile, counted in found.items() if counted is not None}
        result_file = self.folder / RECORDS / f"{self.name}.npz"
        note, _ = read_counted(result_file)
        if kind and len(done) == len(work) and not self.tiles.broken and note.get("key") == whole:
            return self._told(kind(**note["result"]))
        before = set(done)
        for tile in work:
            if tile not in before:
                check_cloud(tile.target, overwrite=self.options.overwrite, inputs=self.tiles.paths)
        step, tiles = self._made(make)
        failed = {path_of(path).name: why for path, why in tiles.broken.items()}
        todo = [
            tile
            for tile, path in zip(work, self.tiles.paths, strict=True)
            if tile not in done and path in tiles.paths
        ]
        with threads(self.options.jobs):
            step.begin(0)
            for tile, outcome in self._results(step, todo):
                if isinstance(outcome, str):
                    failed[tile.source.name] = outcome
                else:
                    done[tile] = outcome
                if self.progress is not None:
                    self.progress(sum(one.points for one in done), len(self.tiles))
            for tile in work:  # in their order, so that no sum depends on who was first
                if tile in done:
                    step.add_counted(done[tile])
            try:
                if done:
                    step.finish()
            except PcfixError:
                for tile in done.keys() - before:
                    tile.record.unlink(missing_ok=True)
                    tile.target.unlink(missing_ok=True)
                raise
        result = self._told(tell(step)) if done else None
        if failed:
            raise InputError(
                f"{self.tiles}: {len(failed)} of {len(work)} files failed, the others are finished"
                " (the same command goes on, once these are mended):\n"
                + "\n".join(f"  {why}" for _, why in sorted(failed.items()))
            )
        if kind:
            write_counted(result_file, {"key": whole, "result": vars(result)}, {})
        return result

    def _told(self, result: Any) -> Any:
        FileTask(
            self.folder, self.folder, getattr(self.options, "summary", None), self.options.overwrite
        ).tell(result.as_dict() if hasattr(result, "as_dict") else {"points": result})
        return result

    def _check_folder(self) -> None:
        """Make the folder of the outputs; refuse one that has inputs, or lies in their folder."""
        folder, named = self.folder.resolve(), path_of(self.tiles.name)
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

    def _work(self, key: str) -> list[Tile]:
        """Return a tile for each file."""
        work, row = [], 0
        for path, points in zip(self.tiles.paths, self.tiles.points, strict=True):
            source = path if "://" in str(path) else path.resolve()
            target = self.folder.resolve() / output_name(path)
            work.append(Tile(source, target, points, row, key, version.__version__))
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

    def _results(self, step: TileStep, todo: list[Tile]) -> Iterator[tuple[Tile, Counted | str]]:
        pickled = pickle.dumps(step)
        if self.options.scheduler is not None:
            return on_cluster(self.options.scheduler, do_tile, pickled, todo)
        return in_processes(self.options.jobs, do_tile, pickled, todo)


def _plain(value: Any) -> Any:
    """Return an option as JSON holds it; of a file or a folder its content counts."""
    if isinstance(value, OptionSet):
        return value.as_dict()
    if isinstance(value, str) or hasattr(value, "joinpath"):
        path = Path(str(value).partition("|")[0])
        return digest_of(path) if path.exists() else str(value)
    if value is None or isinstance(value, int | float | tuple):
        return value
    return sha256(pickle.dumps(value)).hexdigest()


def _digest(path: File) -> str:
    return digest_of(path_of(path))
