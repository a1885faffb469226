"""The tables of options in pcfix/cli/README.md, made from their declarations.

python -m tests.utils.option_tables     writes them again
"""

import re
from pathlib import Path

from pcfix.cli.commands import COMMANDS
from pcfix.options.declare import OptionSet, options_of

DOCUMENT = Path(__file__).parents[2] / "pcfix" / "cli" / "README.md"


def table_of(kind: type[OptionSet]) -> str:
    """Return the options of a class as a table."""
    rows = ["| option | meaning | default |", "|---|---|---|"]
    for one in options_of(kind):
        plain = "" if bool in one.kinds else "TEXT" if one.kinds == (str,) else "N"
        value = "\\|".join(one.choices) or one.metavar or ("PATH" if one.is_path else plain)
        flag = f"{one.flag} {value}".strip()
        rows.append(f"| `{flag}` | {one.help} | {one.needed or one.default_text} |")
    return "\n".join(rows)


def with_tables(text: str) -> str:
    """Return a document with a current table between the marks of each command."""

    def between(found: re.Match[str]) -> str:
        name = found.group(1)
        table = table_of(COMMANDS[name.replace("_", "-")].kind)
        return f"<!-- options of {name} -->\n{table}\n<!-- end -->"

    return re.sub(r"<!-- options of (\w+) -->\n.*?<!-- end -->", between, text, flags=re.S)


if __name__ == "__main__":
    DOCUMENT.write_text(with_tables(DOCUMENT.read_text("utf-8")), "utf-8")
