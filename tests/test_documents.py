"""What the documents promise: tables made from the code, a short README, pictures of a size."""

from __future__ import annotations

from pathlib import Path

from tests.utils.option_tables import DOCUMENT, with_tables

ROOT = Path(__file__).parents[1]


def test_tables_of_options_are_current():
    """Run ``python -m tests.utils.option_tables`` where this fails."""
    text = DOCUMENT.read_text("utf-8")
    assert text.count("<!-- options of ") >= 10
    assert with_tables(text) == text


def test_readme_is_short_and_pictures_are_small():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 200
    pictures = [*ROOT.glob("samples/**/*.png"), *ROOT.glob("samples/**/*.jpg")]
    assert 0 < sum(path.stat().st_size for path in pictures) < 1_000_000
