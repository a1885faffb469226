"""Arrays on disk for what may be larger than memory."""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy.typing as npt

    from pcfix.clean.tiles import Empty


@contextmanager
def scratch_arrays(target: Path) -> Iterator[Empty]:
    """Give a maker of arrays in temporary files beside the target, gone when the block ends.

    Raises
    ------
    InputError
        If the disk cannot hold them.
    """
    try:
        folder = tempfile.TemporaryDirectory(
            prefix=f".{target.stem}.", suffix=".part", dir=target.parent, ignore_cleanup_errors=True
        )
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}).") from error
    made: list[Path] = []

    def empty(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        made.append(Path(folder.name) / f"{len(made)}.bin")
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        try:
            _reserve(made[-1], size)
        except OSError as error:
            raise InputError(
                f"{target}: {size / 1e9:,.1f} GB of temporary space beside it cannot be had"
                f" ({error.strerror or error}); make room, or write to another disk."
            ) from error
        return np.memmap(made[-1], dtype=dtype, mode="r+", shape=shape)

    with folder:
        yield empty


def _reserve(path: Path, size: int) -> None:
    """Make a file of a size that the disk really has: a full disk kills whoever writes to a map."""
    with path.open("wb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, size)
        else:
            stream.truncate(size)
