"""Check the documents, the help and the messages: tables, commands, links, spelling, words."""

import ast
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pcfix.cli import app_for
from pcfix.cli.commands import COMMANDS
from pcfix.options.declare import options_of
from tests.utils.option_tables import DOCUMENT, with_tables

ROOT = Path(__file__).parents[1]


def test_option_tables():
    """Run ``python -m tests.utils.option_tables`` where this fails."""
    text = DOCUMENT.read_text("utf-8")
    assert text.count("<!-- options of ") >= 10
    assert with_tables(text) == text


def test_sizes():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 150
    pictures = [*ROOT.glob("samples/*.png"), *ROOT.glob("samples/figures/*.svg")]
    assert 0 < sum(path.stat().st_size for path in pictures) < 300_000


def anchors(path):
    """Return the anchors of the headings of a document, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}


def test_links():
    for path in ROOT.glob("[!.]*/**/*.md"):
        for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text("utf-8")):
            file, _, anchor = link.partition("#")
            if not file.startswith("http"):
                target = path.parent / file if file else path
                assert target.exists(), (path, link)
                assert not anchor or anchor in anchors(target), (path, link)


# Parts of a line that is not a command, such as ``INPUT [OPTION]``.
PATTERN = re.compile(r"[\[\]|]|\.\.\.|(?<!\S)[A-Z_]{3,}(?!\S)")


def commands():
    """Return the commands in the documents, each with its document."""
    found = {}
    for path in (*ROOT.glob("*.md"), *ROOT.glob("samples/*.md"), *ROOT.glob("pcfix/**/*.md")):
        text = path.read_text("utf-8").replace("\\\n", " ")
        blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S)
        shell = "\n".join(block for language, block in blocks if not language)
        lines = re.findall(r"^pcfix .*", shell, re.M) + re.findall(
            r"`(pcfix [a-z]+ [^-].*?)`", text
        )
        found |= {line: path for line in lines if not PATTERN.search(line)}
    return found


def test_commands():
    assert len(commands()) > 20
    for line, path in commands().items():
        words = shlex.split(line, comments=True)[1:]
        try:
            app, kind = app_for(words), COMMANDS[words[0]].kind
            given = app.parse_args(words, exit_on_error=False, print_error=False)[1].arguments
            kind(**{one.name: given[one.name] for one in options_of(kind) if one.name in given})
        except Exception as error:
            pytest.fail(f"{path.name}: {line}: {error}")


# Words of the project's former idiom, which readers did not understand.
IDIOM = re.compile(
    r"\b(anew|mend(s|ed|ing)?|bent|so many|by itself|told|tells|kept|came|said|beside|stands|lies"
    r"|goes by|leaves? out|left out|in sight|doubts?|steep(er|est)?)\b", re.I
)  # fmt: skip


def help_text():
    """Return the help of all commands and options."""
    lines = []
    for name, one in COMMANDS.items():
        lines += [f"{name}: {text}" for text in (one.call.__doc__, *one.helps.values())]
        for each in options_of(one.kind):
            lines.append(f"{name} {each.flag}: {each.help} {each.needed} {each.default_text}")
    return "\n".join(lines)


def test_idiom_of_help():
    assert [line for line in help_text().splitlines() if IDIOM.search(line)] == []


def messages():
    """Yield file, line and text of every string of four words or more in the code."""
    for path in ROOT.glob("pcfix/**/*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            text = node.value if isinstance(node, ast.Constant) else None
            if isinstance(text, str) and id(node) not in docstrings and len(text.split()) > 3:
                yield path.relative_to(ROOT), node.lineno, text


def test_idiom_of_messages():
    assert [one for one in messages() if IDIOM.search(one[-1])] == []


def test_spelling():
    pytest.importorskip("codespell_lib")
    folders = ("*", "samples/*", "pipelines/*", "pcfix/**/*", "tests/**/*")
    documents = [str(path) for folder in folders for path in ROOT.glob(f"{folder}.md")]
    words = [sys.executable, "-m", "codespell_lib", "-L", "trough", *documents, "-"]
    done = subprocess.run(words, input=help_text(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_idiom_of_documents():
    idiom = re.compile(r"\b(anew|mend(s|ing)?|bent|so many|by itself)\b")
    for folder in ("", "samples", "pipelines", "pcfix/cli"):
        lines = (ROOT / folder / "README.md").read_text("utf-8").splitlines()
        assert [line for line in lines if idiom.search(line)] == [], folder
