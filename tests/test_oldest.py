"""The bounds of pyproject.toml are those that the second environment is made with."""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

TESTS = Path(__file__).parent


def test_the_oldest_that_is_tried_is_the_oldest_that_is_allowed():
    lines = (TESTS / "oldest.txt").read_text().splitlines()
    tried = dict(line.split("==") for line in lines if not line.startswith("#"))
    project = tomllib.loads((TESTS.parent / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    for text in [*project["dependencies"], *(one for extra in extras for one in extra)]:
        need = Requirement(text)
        name = need.name.lower().replace("_", "-")
        if name in ("pcfix", "open3d", "pdal", "pdal-plugins"):  # install_pdal.sh has its own
            continue
        (bound,) = (one.version for one in need.specifier if one.operator == ">=")
        assert Requirement(f"{name}=={bound}").specifier.contains(tried[name]), text
