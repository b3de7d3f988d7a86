"""The compiled Mersenne Twister draws torch's own numbers."""

import pytest
import torch

from memcomp_lightning import rng, twister


@pytest.mark.parametrize("before", [0, 1, 623, 624, 625])
@pytest.mark.parametrize("shape", [(0,), (1,), (5, 7), (624,), (3, 1000)], ids=str)
def test_numbers_and_state_are_torchs(before, shape):
    ours, theirs = rng.stream(3, "twister"), rng.stream(3, "twister")
    for generator in (ours, theirs):
        torch.empty(before).uniform_(generator=generator)
    for _ in range(2):
        found, wanted = (torch.full(shape, torch.nan) for _ in range(2))
        twister.fill(found, ours)
        assert found.equal(wanted.uniform_(generator=theirs))
    # What follows is the same as well, whoever draws it.
    assert ours.get_state().equal(theirs.get_state())
    assert torch.empty(9).normal_(generator=ours).equal(torch.empty(9).normal_(generator=theirs))


def test_it_notices_other_numbers(monkeypatch):
    assert twister.agrees()
    monkeypatch.setattr(twister, "fill", lambda out, generator: out.uniform_(0.0, 0.5, generator=generator))
    assert not twister.agrees()


def test_draws_are_the_same_before_and_after_it_is_loaded(monkeypatch):
    n, found = rng._MANY, []
    for pays_after in (10**9, 0):
        monkeypatch.setattr(rng, "_PAYS_AFTER", pays_after)
        monkeypatch.setattr(rng, "_drawn", [0])
        generator = rng.stream(0, "draws")
        assert (rng._compiled_for(torch.empty(n)) is None) == (pays_after > 0)
        found.append([rng.uniform((k,), generator=generator) for k in (n, 3, n + 1)])
    assert all(a.equal(b) for a, b in zip(*found, strict=True))


def test_it_draws_no_double_numbers_and_few_ones_by_itself(monkeypatch):
    monkeypatch.setattr(rng, "_PAYS_AFTER", 0)
    assert rng._compiled_for(torch.empty(rng._MANY, dtype=torch.float64)) is None
    assert rng._compiled_for(torch.empty(rng._MANY - 1)) is None
