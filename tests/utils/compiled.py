"""Call device functions from Python, which only kernels can do otherwise."""

from typing import Any

import numba


def compiled(device: Any) -> Any:
    """Return a function that Python can call."""

    @numba.njit(error_model="numpy")
    def call(*arguments):
        return device(*arguments)

    return call
