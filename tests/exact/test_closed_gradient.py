"""Gradients that are added without a graph are those of the contrast."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.objective import Offsets, add_gradient, contrast
from memcomp_lightning.testing import small_machines, small_rbms
from memcomp_lightning.testing.conformance import small_rbm
from memcomp_lightning.types import Configurations

MODELS = small_rbms() | small_machines()
MODELS |= {f"replicas {axes}": lambda axes=axes: small_rbm(replicas=axes) for axes in [(3,), (2, 3)]}


def drawn(model, n, name):
    """Configurations with weights."""
    generator = rng.stream(0, name)
    parts = [
        units.sample(torch.zeros(*model.replicas, n, units.n).to(model.b), generator=generator)
        for units in (model.visible, model.hidden)
    ]
    weight = rng.uniform((*model.replicas, n), generator=generator, like=model.b) + 0.5
    return Configurations(*parts, weight)


def offsets_of(model, centred):
    if not centred:
        return None
    generator = rng.stream(0, "offsets")
    shapes = [(*model.replicas, n) for n in (model.n_visible, model.n_hidden)]
    return Offsets(*(rng.uniform(shape, generator=generator, like=model.b) for shape in shapes))


def check(model, centred):
    """An update in two batches, which share a negative phase."""
    offsets = offsets_of(model, centred)
    negative = drawn(model, 5, "negative")
    batches = [(0.3, drawn(model, 4, "first")), (0.7, drawn(model, 3, "second"))]
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    gaps = [contrast(model, positive, negative, offsets) for _, positive in batches]
    loss = sum(share * gap.sum() for (share, _), gap in zip(batches, gaps, strict=True))
    true = torch.autograd.grad(loss, parameters)
    for (share, positive), gap in zip(batches, gaps, strict=True):
        found = add_gradient(model, positive, negative, offsets, share=share)
        assert not found.requires_grad
        torch.testing.assert_close(found, gap.detach())
    for parameter, gradient in zip(parameters, true, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_it_is_that_of_the_contrast(name, centred):
    check(MODELS[name]().double(), centred)


@pytest.mark.parametrize("name", ["_own_moments", "_of_centred_measures"])
def test_units_that_are_not_centred_are_seen(name, monkeypatch):
    model, of_contrast = MODELS["real x bits"]().double(), []
    right = getattr(type(model), name)

    def first_right(*arguments):
        """Of the contrast, for both batches; then of plain units."""
        of_contrast.append(name)
        return right(*arguments) if len(of_contrast) <= 2 else arguments[1] if name == "_own_moments" else 0.0

    monkeypatch.setattr(type(model), name, first_right)
    with pytest.raises((AssertionError, TypeError)):
        check(model, centred=True)


def test_parameters_at_rest_get_none():
    rbm = small_rbm()
    rbm.b.requires_grad_(False)
    add_gradient(rbm, drawn(rbm, 4, "positive"), drawn(rbm, 4, "negative"), valued=False)
    assert rbm.b.grad is None
    assert rbm.weight.grad is not None


def test_few_digits_are_rounded_once():
    """Both phases are alike, so that rounding one of them by itself would hide what they differ by."""
    rbm = small_rbm(7, 5)
    positive, negative = drawn(rbm, 200, "positive"), drawn(rbm, 200, "negative")
    positive, negative = (some._replace(weight=None) for some in (positive, negative))
    add_gradient(rbm, positive, negative)
    half = small_rbm(7, 5).bfloat16()
    add_gradient(half, *(Configurations(some.v.bfloat16(), some.h.bfloat16()) for some in (positive, negative)))
    error = (half.weight.grad.float() - rbm.weight.grad).abs()
    assert (error <= 2**-7 * rbm.weight.grad.abs() + 1e-6).all()


def test_a_model_without_a_closed_form_goes_through_autograd():
    class Own(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.a = torch.nn.Parameter(torch.tensor([0.5, -0.5]))

        def total_energy(self, v, h, weight):
            return (weight * (v @ self.a).square()).sum(-1)

    model, positive, negative = (
        Own(),
        *(Configurations(rng.uniform((3, 2), generator=rng.stream(0, x)), torch.zeros(3, 1)) for x in "ab"),
    )
    gap = add_gradient(model, positive, negative, share=0.5, valued=False)
    true = contrast(model, positive, negative)
    torch.testing.assert_close(gap, true.detach())
    torch.testing.assert_close(model.a.grad, torch.autograd.grad(0.5 * true, model.a)[0])
