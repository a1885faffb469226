"""Damaged files of every reader: one sentence each, or a result that is fit for use."""

from __future__ import annotations

import random

import pytest

from tests.faults.judge import Bench
from tests.faults.mutations import mutated
from tests.faults.readers import READERS

SEEDS = [1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(2, 12))]


@pytest.fixture(scope="module", params=READERS)
def bench(request, tmp_path_factory):
    return Bench(request.param, tmp_path_factory.mktemp("bench"))


def test_what_is_whole_is_read(bench):
    for part in {part.seed: part for part in bench.parts}.values():
        results, sentence = bench.read(part, part.data)
        assert results or "unsupported" in bench.reader.modules[0], sentence


@pytest.mark.parametrize("seed", SEEDS)
def test_mutations(bench, seed):
    chance = random.Random(seed)
    for _ in range(30):
        part = chance.choice(bench.parts)
        bench.read(part, mutated(part.data, chance))
