"""What several of these files leave out or share."""

import pytest


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures of pages blank: to draw those of a run takes longer than its steps.

    For tests of what a run keeps, repeats or says. Others look at pages as they are.
    """
    monkeypatch.setattr("pcfix.report.page.png_of", lambda figure: b"\x89PNG\r\n\x1a\n")
