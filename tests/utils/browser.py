"""A real browser without a screen: Chromium, where it is installed."""

import shutil
import subprocess
from pathlib import Path

import pytest

PROGRAM = shutil.which("chromium") or shutil.which("google-chrome")

needs_browser = pytest.mark.skipif(PROGRAM is None, reason="no chromium on this machine")

QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-quic", "--disable-dev-shm-usage", "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip


# Of the page's own clock, which stands still where work waits for nothing else: a busy machine
# unpacks the map while many ticks go by, and when all is done the rest is skipped at once.
PATIENCE_MS = 600_000


def open_page(page: Path, profile: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """Open a page, let its scripts run, and return its DOM and what the browser logs."""
    words = [
        str(PROGRAM), *QUIET, f"--user-data-dir={profile}", "--enable-logging=stderr",
        f"--virtual-time-budget={PATIENCE_MS}", *more, "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    return subprocess.run(words, capture_output=True, text=True, check=True, timeout=120)
