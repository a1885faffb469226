"""The blocks of these tests are so small that one thread is faster."""

import pytest


@pytest.fixture(autouse=True)
def _one_thread(one_thread):
    """Use one thread in every test."""
