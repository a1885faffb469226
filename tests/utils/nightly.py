"""What a night's run repeats with other numbers: parameters of tests with the marker `nightly`."""

import pytest


def mostly_nightly(cases, *by_day):
    """Return the parameters of a test, with the marker but for those that every run has."""
    return [
        case if case in by_day else pytest.param(*values_of(case), marks=pytest.mark.nightly)
        for case in cases
    ]


def values_of(case):
    return case if isinstance(case, tuple) else (case,)
