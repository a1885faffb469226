"""The tables of options in pcfix/cli/README.md, made from their declarations.

python -m tests.utils.option_tables     writes them again

Options that several commands share are described once, in the section of their panel. A command
lists their names, and describes only its own options. The most important options come first.
"""

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from pcfix.cli.commands import COMMANDS
from pcfix.options.declare import Option, options_of
from pcfix.options.shared import Panel

DOCUMENT = Path(__file__).parents[2] / "pcfix" / "cli" / "README.md"
BY_COMMAND = {
    name: sorted(options_of(one.kind), key=lambda option: not option.basic)
    for name, one in COMMANDS.items()
}
EVERY = [option for options in BY_COMMAND.values() for option in options]
USES = Counter((option.name, option.help, option.default_text) for option in EVERY)


def is_shared(option: Option) -> bool:
    return USES[option.name, option.help, option.default_text] > 1


def table(options: Iterable[Option]) -> list[str]:
    """Return options as the lines of a table, each once."""
    rows = {}
    for one in options:
        plain = "" if bool in one.kinds else "TEXT" if one.kinds == (str,) else "N"
        value = "|".join(one.choices) or one.metavar or ("PATH" if one.is_path else plain)
        both = f"`, `--no-{one.flag[2:]}" if one.default is True else ""
        flag = f"{one.flag}{both} {value}".strip().replace("|", "\\|")
        rows.setdefault(one.name, f"| `{flag}` | {one.help} | {one.needed or one.default_text} |")
    return ["| option | meaning | default |", "|---|---|---|", *rows.values()]


def of_command(name: str) -> str:
    """Return the shared options of a command by panel, and a table of the others."""
    options, lines = BY_COMMAND[name], []
    for panel in Panel:
        names = [f"`{one.flag}`" for one in options if is_shared(one) and one.panel == panel]
        if names:
            lines.append(f"- [{panel}](#{panel.lower().replace(' ', '-')}): {', '.join(names)}")
    own = [one for one in options if not is_shared(one)]
    head = ["[Shared options](#shared-options):", ""]
    return "\n".join([*head, *lines, *(["", *table(own)] if own else [])])


def with_tables(text: str) -> str:
    """Return a document with current tables between the marks of commands and of panels."""

    def between(found: re.Match[str]) -> str:
        kind, name = found.groups()
        if kind == "of":
            content = of_command(name.replace("_", "-"))
        else:
            shared = [one for one in EVERY if is_shared(one) and one.panel == Panel[name]]
            content = "\n".join(table(sorted(shared, key=lambda option: not option.basic)))
        return f"<!-- options {kind} {name} -->\n{content}\n<!-- end -->"

    return re.sub(r"<!-- options (of|in) (\w+) -->\n.*?<!-- end -->", between, text, flags=re.S)


if __name__ == "__main__":
    DOCUMENT.write_text(with_tables(DOCUMENT.read_text("utf-8")), "utf-8")
