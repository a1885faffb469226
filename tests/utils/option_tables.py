"""The tables of options in pcfix/cli/README.md, made from their declarations.

python -m tests.utils.option_tables     writes them again
"""

from __future__ import annotations

import re
from pathlib import Path

from pcfix.cli.commands import EXAMPLES
from pcfix.cli.flags import kind_of
from pcfix.options.declare import table_of

DOCUMENT = Path(__file__).parents[2] / "pcfix" / "cli" / "README.md"


def with_tables(text: str) -> str:
    """Return a document with a current table between the marks of each command."""
    kinds = {command.__name__: kind_of(command) for command, _ in EXAMPLES}

    def between(found: re.Match[str]) -> str:
        name = found.group(1)
        return f"<!-- options of {name} -->\n{table_of(kinds[name])}\n<!-- end -->"

    return re.sub(r"<!-- options of (\w+) -->\n.*?<!-- end -->", between, text, flags=re.S)


if __name__ == "__main__":
    DOCUMENT.write_text(with_tables(DOCUMENT.read_text("utf-8")), "utf-8")
