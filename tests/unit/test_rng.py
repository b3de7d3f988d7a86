"""Named random streams."""

import inspect

import pytest
import torch

from memcomp_lightning import rng


def draws(generator, n=1009):
    return rng.uniform((n,), generator=generator)


def test_same_seed_name_and_index_give_the_same_stream():
    assert draws(rng.stream(5, "negative_phase", 2)).equal(draws(rng.stream(5, "negative_phase", 2)))


@pytest.mark.parametrize("other", [(6, "negative_phase", 2), (5, "data_order", 2), (5, "negative_phase", 3)])
def test_another_seed_name_or_index_gives_an_independent_stream(other):
    a, b = draws(rng.stream(5, "negative_phase", 2)), draws(rng.stream(*other))
    assert (a == b).float().mean() < 0.01
    assert abs(torch.corrcoef(torch.stack((a, b)))[0, 1]) < 5 / 1009**0.5


def test_stream_is_the_same_on_every_machine():
    measured = torch.tensor([0.7630506753921509, 0.04370081424713135, 0.3239746689796448])
    stream = inspect.unwrap(rng.stream)  # the usual one under MEMCOMP_SEED, too
    torch.testing.assert_close(draws(stream(0, "negative_phase"), 3), measured, rtol=0, atol=1e-7)


def test_streams_gives_each_name_its_own_stream():
    generators = rng.streams(5, ["a", "b"], index=2)
    assert draws(generators["a"]).equal(draws(rng.stream(5, "a", 2)))
    assert draws(generators["b"]).equal(draws(rng.stream(5, "b", 2)))


def test_restored_streams_continue_where_they_were_saved():
    generators = rng.streams(0, ["a", "b"])
    draws(generators["a"])
    saved = rng.save(generators)
    expected = [draws(generators["a"]), draws(generators["b"])]
    fresh = rng.streams(1, ["a", "b"])
    rng.restore(fresh, saved)
    assert [draws(fresh["a"]).equal(expected[0]), draws(fresh["b"]).equal(expected[1])] == [True, True]


def test_saved_state_does_not_move_with_the_stream():
    generators = rng.streams(0, ["a"])
    saved = rng.save(generators)
    expected = draws(generators["a"])
    rng.restore(generators, saved)
    assert draws(generators["a"]).equal(expected)


def test_missing_state_is_named_with_those_saved():
    with pytest.raises(KeyError, match=r"no saved state of the random stream 'b'; saved: \['a', 'c'\]"):
        rng.restore(rng.streams(0, ["a", "b"]), rng.save(rng.streams(0, ["a", "c"])))


def test_more_states_than_streams_are_accepted():
    saved = rng.save(rng.streams(0, ["a", "c"]))
    fresh = rng.streams(1, ["a"])
    rng.restore(fresh, saved)
    assert draws(fresh["a"]).equal(draws(rng.stream(0, "a")))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_draws_follow_the_dtype(dtype):
    like = torch.zeros((), dtype=dtype)
    u = rng.uniform((3, 1009), generator=rng.stream(0, "a"), like=like)
    assert u.dtype == dtype
    assert u.min() >= 0
    assert u.max() < 1
    assert abs(u.mean() - 0.5) < 5 / (12 * 3027) ** 0.5
    assert rng.bernoulli(u, generator=rng.stream(0, "a")).dtype == dtype


def test_bernoulli_has_its_probabilities():
    probability = torch.tensor([0.0, 0.13, 0.5, 0.83, 1.0]).repeat(20011, 1)
    sample = rng.bernoulli(probability, generator=rng.stream(0, "a"))
    assert set(sample.unique().tolist()) == {0.0, 1.0}
    deviation = (probability * (1 - probability) / 20011).sqrt()[0]
    assert ((sample.mean(0) - probability[0]).abs() <= 5 * deviation + 1e-6).all()
    assert not sample[:, 0].any()
    assert sample[:, 4].all()
