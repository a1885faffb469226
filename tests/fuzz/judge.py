"""One reading of damaged files: a sentence, or a result that is fit for use, else a finding."""

import io
import resource
import signal
import time
import traceback
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np

import pcfix
from pcfix.model import Cameras, GroundControl, TiePoints, Views
from tests.fuzz.readers import READERS

# Of processor time, kernels compiled included; else an undamaged seed takes at most 0.2 s.
LONGEST_S = 60.0
# Of address space that a reading may ask for, beside what the process has.
MOST_BYTES = 1_500_000_000
LONGEST_SENTENCE = 800  # letters, with the path; most have 100 to 250
# Fields in which NaN says that a number is not known.
UNKNOWN = ("gnss", "sigma_m", "sigma_px", "sigma_on", "on_sigma_m", "height_m", "water_m")


class Finding(Exception):  # noqa: N818  # what is looked for, not what went wrong
    """What a reader should not have done."""


class Late(BaseException):
    """The time is over; no reader catches it."""


class Part(NamedTuple):
    """A file of a seed, or an entry of an archive."""

    seed: str
    path: Path
    entry: str
    data: bytes


class Bench:
    """The files of a reader's seeds in a folder, one of which is damaged at a time."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.reader, self.folder = name, READERS[name], folder
        self._given: dict[str, Path] = {}
        self.parts: list[Part] = []
        for i, (seed, write) in enumerate(self.reader.seeds.items()):
            home = folder / f"seed_{i}"
            home.mkdir()
            self._given[seed] = write(home)
            self.parts += _parts(seed, home)

    def read(self, part: Part, data: bytes) -> tuple[int, str]:
        """Read the files of a seed with other bytes in one of them.

        Return how many results there were, and the sentence if the last was refused. A `Finding`
        if one is not as it should be.
        """
        whole = part.path.read_bytes()
        part.path.write_bytes(_packed(whole, part.entry, data) if part.entry else data)
        try:
            return self._judged(self._given[part.seed])
        finally:
            part.path.write_bytes(whole)

    def _judged(self, path: Path) -> tuple[int, str]:
        began, results = time.process_time(), 0
        said: list[str] = []
        with warnings.catch_warnings(record=True) as shown:
            warnings.simplefilter("always", pcfix.PcfixWarning)
            try:
                with within(LONGEST_S):
                    for found in self.reader.read(path):
                        check_result(found)
                        results += 1
            except pcfix.PcfixError as error:
                said.append(str(error))
            except Finding:
                raise
            except Late:
                raise Finding(f"late: still busy after {LONGEST_S:g} s") from None
            except BaseException as error:
                raise Finding(_place(error)) from error
        if time.process_time() - began > LONGEST_S:
            raise Finding(f"late: {time.process_time() - began:.1f} s")
        own = [str(one.message) for one in shown if issubclass(one.category, pcfix.PcfixWarning)]
        for sentence in said + own:
            self._check_sentence(sentence)
        return results, said[0] if said else ""

    def _check_sentence(self, sentence: str) -> None:
        if not sentence.isprintable():
            raise Finding(f"sentence: is not one line of text: {sentence!r}")
        if len(sentence) > LONGEST_SENTENCE:
            raise Finding(f"sentence: has {len(sentence)} letters: {sentence}")
        if str(self.folder) not in sentence:
            raise Finding(f"sentence: names no file: {sentence}")


def _parts(seed: str, home: Path) -> Iterator[Part]:
    """Yield the files of a seed but for pictures beside others, and what is in its archives."""
    paths = [one for one in sorted(home.rglob("*")) if one.is_file()]
    held = [one for one in paths if one.suffix not in (".jpg", ".png")] or paths
    for path in held:
        data = path.read_bytes()
        yield Part(seed, path, "", data)
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                for entry in archive.namelist():
                    yield Part(seed, path, entry, archive.read(entry))


def _packed(whole: bytes, entry: str, data: bytes) -> bytes:
    """Return an archive with another content of one entry."""
    held = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as before, zipfile.ZipFile(held, "w") as archive:
        for one in before.namelist():
            archive.writestr(one, data if one == entry else before.read(one))
    return held.getvalue()


def _place(error: BaseException) -> str:
    """Return what an error is and where in pcfix it came from, the same for each like it."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/pcfix/" in f.filename]
    where = "outside"
    if frames:
        file = frames[-1].filename.rpartition("/pcfix/")[2]
        where = f"{file}:{frames[-1].lineno} {frames[-1].name}"
    return f"{type(error).__name__} at {where}: {str(error)[:200]}"


@contextmanager
def within(longest_s: float) -> Iterator[None]:
    """Raise `Late` in the block once it has used so much of the processor, and bound its memory."""

    def late(number: int, frame: FrameType | None) -> None:
        raise Late

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = signal.signal(signal.SIGPROF, late)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, hard))
    signal.setitimer(signal.ITIMER_PROF, longest_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def check_result(found: Any, name: str = "result") -> None:
    """Raise a `Finding` where a number is not finite that should be, or places do not exist."""
    if isinstance(found, Cameras):
        _check_cameras(found)
    if isinstance(found, Views):
        start, camera = found.start, found.camera
        fits = (np.diff(start) >= 0).all() and [start[0], start[-1]] == [0, len(camera)]
        if not fits or camera.min(initial=0) < 0:
            raise Finding(f"{name}: lists of views that do not fit")
    if isinstance(found, TiePoints):
        known = np.isfinite(found.xyz)
        if (known.any(axis=1) != known.all(axis=1)).any():
            raise Finding("tie points: known in part")
        check_result(found.image_xy, "tie points: image_xy")
        check_result(found.views, "tie points")
    elif is_dataclass(found) and not isinstance(found, type):
        for one in fields(found):
            if one.name not in UNKNOWN and not (
                isinstance(found, GroundControl) and one.name == "xyz"
            ):
                check_result(getattr(found, one.name), f"{name}.{one.name}")
    elif isinstance(found, np.ndarray | float | np.floating):
        numbers = np.asarray(found)
        if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
            raise Finding(f"{name}: not finite")
    elif isinstance(found, tuple | list):
        for one in found:
            check_result(one, name)


def _check_cameras(found: Cameras) -> None:
    if len({len(found.labels), len(found.centres)}) != 1:
        raise Finding("cameras: labels and centres differ in number")
    if found.rotations is not None:
        square = found.rotations @ found.rotations.transpose(0, 2, 1)
        if not (np.abs(square - np.eye(3)) < 1e-6).all():
            raise Finding("cameras: a rotation is none")
    for lens in found.lenses or ():
        if lens is not None and not min(lens.focal, lens.width, lens.height) > 0.0:
            raise Finding("cameras: a lens without a focal length or a frame")
