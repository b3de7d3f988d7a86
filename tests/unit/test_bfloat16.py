"""Products in bfloat16: of CD and PCD alone, while they sweep, on processors that multiply so."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.samplers import CD, PCD, InBfloat16, ParallelTempering, bfloat16, positive_phase
from memcomp_lightning.testing.conformance import small_rbm


def precision():
    return torch.backends.mkldnn.matmul.fp32_precision


@pytest.fixture
def able(monkeypatch):
    monkeypatch.setattr(bfloat16, "multiplies_in_bfloat16", lambda: True)


def sampled(sampler, model):
    generator = rng.stream(0, "negative_phase")
    positive = positive_phase(model, torch.ones(5, model.n_visible, dtype=model.b.dtype))
    state = sampler.init(model, 5, generator=generator)
    return sampler.sample(model, state, positive, generator=generator)


@pytest.mark.parametrize("inner", [CD(), CD(k=3), PCD(n_chains=4)], ids=str)
def test_products_are_rounded_while_the_chain_is_swept_and_no_longer(able, monkeypatch, inner):
    model, before, seen = small_rbm(), precision(), []
    own = type(model).draw_visible

    def watched(*arguments, **settings):
        seen.append(precision())
        return own(*arguments, **settings)

    monkeypatch.setattr(type(model), "draw_visible", watched)
    sampled(InBfloat16(sampler=inner), model)
    assert set(seen) == {"bf16"}
    assert precision() == before


def test_an_error_in_the_sweep_leaves_torch_as_it_was(able, monkeypatch):
    model, before = small_rbm(), precision()
    monkeypatch.setattr(type(model), "draw_visible", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        sampled(InBfloat16(sampler=CD()), model)
    assert precision() == before


def test_without_the_library_for_it_nothing_multiplies_so(monkeypatch):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert bfloat16.multiplies_in_bfloat16.__wrapped__() is False


def test_it_says_of_the_data_what_its_sampler_says():
    assert InBfloat16(sampler=CD()).uses_data
    assert not InBfloat16(sampler=PCD()).uses_data


def test_states_whose_energies_are_compared_are_refused():
    with pytest.raises(SettingError, match=r"'ParallelTempering' is not allowed: expected CD or PCD"):
        InBfloat16(sampler=ParallelTempering())


def test_a_processor_without_it_is_refused(monkeypatch):
    monkeypatch.setattr(bfloat16, "multiplies_in_bfloat16", lambda: False)
    with pytest.raises(SettingError, match=r"in bfloat16, as with AMX.*pretrain\.products=float32"):
        sampled(InBfloat16(sampler=CD()), small_rbm())


@pytest.mark.parametrize("rounds", [True, False])
def test_a_product_tells_whether_torch_rounds(monkeypatch, rounds):
    multiply = torch.Tensor.__matmul__

    def rounded(a, b):
        return multiply(a.bfloat16().float(), b) if precision() == "bf16" and rounds else multiply(a, b)

    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: True)
    found = bfloat16.multiplies_in_bfloat16.__wrapped__()
    assert found or not rounds  # a processor may round by itself
