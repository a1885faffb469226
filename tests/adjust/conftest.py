"""Small blocks lose more by waking a second thread than they gain."""

import pytest

from pcfix.running import threads


@pytest.fixture(autouse=True)
def _one_thread():
    with threads(1):
        yield
