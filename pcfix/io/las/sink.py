"""Write a LAS or LAZ file chunk by chunk, beside its target, and rename it when it is whole."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import laspy
import lazrs

from pcfix.errors import InputError, SettingError
from pcfix.io.files import replaced_when_whole
from pcfix.io.las.records import append_evlrs
from pcfix.io.las.source import IDENTITY_PLACE, backend

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pcfix.io.las.records import Record


def check_suffix(path: Path) -> bool:
    """Return whether a name asks for LAZ rather than LAS.

    Raises
    ------
    SettingError
        If it asks for neither.
    """
    suffix = path.suffix.lower()
    if suffix not in (".las", ".laz"):
        raise SettingError(f"{path}: give an output name that ends in .las or .laz.")
    return suffix == ".laz"


class LasSink:
    """An output file that is being written. Use it as a context manager.

    Parameters
    ----------
    path : Path
        Its suffix decides between LAS and LAZ.
    header : laspy.LasHeader
    evlrs : list of Record
        To stand behind the points.
    identity : bytes
        To stand in the header as it is; see `LasSource.identity`.
    jobs : int, optional
        Threads.
    """

    def __init__(
        self,
        path: Path,
        header: laspy.LasHeader,
        evlrs: list[Record] | None = None,
        identity: bytes = b"",
        jobs: int | None = None,
    ) -> None:
        self.header = header
        self._path, self._evlrs, self._identity, self._jobs = path, evlrs or [], identity, jobs
        self._stack = ExitStack()

    def __enter__(self) -> LasSink:
        laz = check_suffix(self._path)
        with ExitStack() as stack:
            draft = stack.enter_context(replaced_when_whole(self._path))
            stack.enter_context(_write_errors(self._path))
            self._stream = stack.enter_context(draft.open("w+b"))
            self._writer = laspy.LasWriter(
                self._stream,
                self.header,
                do_compress=laz,
                laz_backend=backend(self._jobs),
                closefd=False,
            )
            self._stack = stack.pop_all()
        return self

    def write(self, points: laspy.ScaleAwarePointRecord) -> None:
        """Append points, in the header's format and scale."""
        with _write_errors(self._path):
            self._writer.write_points(points)

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        with self._stack:
            if kind is not None:
                raise value
            self._writer.close()
            append_evlrs(self._stream, self._evlrs, self.header.version.minor)
            self._stream.seek(IDENTITY_PLACE)
            self._stream.write(self._identity)


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (laspy.LaspyException, lazrs.LazrsError, OSError) as error:
        raise InputError(f"{path}: cannot be written ({error}).") from error
