"""Import libraries that may be missing: those of extras, and open3d, which needs libusb."""

import ctypes
import importlib
import sys
from functools import partial
from pathlib import Path
from typing import Any

from pcfix.errors import InputError


def optional_library(name: str, extra: str, who: str) -> Any:
    """Import a library of an extra; the error names the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        root = Path(__file__).parents[1]
        is_checkout = (root / "pyproject.toml").is_file()
        what = f"-e '{root}[{extra}]'" if is_checkout else f"'pcfix[{extra}]'"
        sentence = f"{who} needs {name}, which is not installed. Run: {sys.executable} -m pip"
        sentence += f" install {what}"
        raise InputError("library.missing", sentence, library=name, extra=extra) from error


analysis_library = partial(optional_library, extra="analysis", who="This")
photo_library = partial(optional_library, extra="photos", who="Work on photographs")


def load_open3d(part: str = "open3d") -> Any:
    """Import open3d, or a part of it, with libusb-1.0.

    The camera drivers in open3d link to libusb-1.0 of the system, which servers often lack. The one
    in the package libusb-package works as well.
    """
    try:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            pass  # the libusb of the system may do
        return importlib.import_module(part)
    except (ImportError, OSError) as error:
        sentence = f"open3d cannot be loaded ({error}). On Debian and Ubuntu: apt-get install"
        sentence += " libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6."
        raise InputError("library.missing", sentence, library="open3d") from error
