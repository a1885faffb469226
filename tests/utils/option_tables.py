"""The tables of options in pcfix/cli/README.md, made from their declarations.

python -m tests.utils.option_tables     writes them anew
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args, get_type_hints

from pcfix.cli.commands import EXAMPLES
from pcfix.options.declare import table_of

DOCUMENT = Path(__file__).parents[2] / "pcfix" / "cli" / "README.md"


def with_tables(text: str) -> str:
    """Return a document with a current table between the marks of each command."""
    kinds = {
        command.__name__: get_args(get_type_hints(command, include_extras=True)["options"])[0]
        for command, _ in EXAMPLES
    }

    def between(found: re.Match[str]) -> str:
        name = found.group(1)
        return f"<!-- options of {name} -->\n{table_of(kinds[name])}\n<!-- end -->"

    return re.sub(r"<!-- options of (\w+) -->\n.*?<!-- end -->", between, text, flags=re.S)


if __name__ == "__main__":
    DOCUMENT.write_text(with_tables(DOCUMENT.read_text("utf-8")), "utf-8")
