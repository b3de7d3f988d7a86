"""Numbers of similar sequences against two loops in plain Python."""

import numpy as np
import pytest

from memcomp_lightning.data.sequences import neighbours, similarity
from memcomp_lightning.data.sequences.alphabets import MISSING


def draw(n, n_sites, q=3, missing=0.0, copies=0):
    generator = np.random.default_rng(n + n_sites)
    numbers = generator.integers(q, size=(n, n_sites)).astype(np.uint8)
    numbers[generator.random((n, n_sites)) < missing] = MISSING
    numbers[:copies] = numbers[n - copies :]
    return numbers


def one_by_one(numbers, percent):
    """As the definition says it, in whole numbers."""
    found = []
    for i, a in enumerate(numbers.tolist()):
        count = 0
        for j, b in enumerate(numbers.tolist()):
            pairs = [(x, y) for x, y in zip(a, b, strict=True) if MISSING not in (x, y)]
            identical = sum(x == y for x, y in pairs)
            count += i == j or a == b or (len(pairs) > 0 and 100 * identical >= percent * len(pairs))
        found.append(count)
    return found


@pytest.mark.parametrize("percent", [20, 50, 55, 80, 100])
@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("rows", [7, 512])
def test_pairs_are_counted(monkeypatch, rows, missing, percent):
    monkeypatch.setattr(similarity, "ROWS", rows)
    numbers = draw(40, 20, missing=missing, copies=3)
    expected = one_by_one(numbers, percent)
    assert neighbours(numbers, percent / 100).tolist() == expected
    assert percent == 100 or max(expected) > min(expected)


def test_long_sequences_are_counted_beyond_a_byte():
    numbers = draw(12, 600, q=2)
    numbers[1:4] = numbers[0]
    numbers[1, :119], numbers[2, :120], numbers[3, :121] = 3, 3, 3
    assert neighbours(numbers, 0.8).tolist() == one_by_one(numbers, 80)
    assert neighbours(numbers, 0.8)[:4].tolist() == [3, 4, 4, 3]


def test_a_share_is_met_exactly():
    """0.55 * 100 is a little more than 55 in floating point."""
    numbers = np.zeros((2, 100), dtype=np.uint8)
    numbers[1, 55:] = 1
    assert neighbours(numbers, 0.55).tolist() == [2, 2]
    numbers[1, 54] = 1
    assert neighbours(numbers, 0.55).tolist() == [1, 1]


def test_sequences_without_a_common_site_are_alone():
    numbers = np.array([[0, MISSING], [MISSING, 0], [MISSING, MISSING]], dtype=np.uint8)
    assert neighbours(numbers, 0.1).tolist() == [1, 1, 1]
