"""What counts more in the loss, and what is left out of the network: the gradient by hand and in closed form."""

import pytest
import torch
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, BatchNormReluNetwork, Linear, Normal, stacked
from memcomp_lightning.modules import DBNClassifier
from memcomp_lightning.training import (
    LOSSES,
    ClassifierStep,
    ClassWeighted,
    Dropout,
    balanced,
    cross_entropy,
)
from memcomp_lightning.types import Batch

WEIGHTS = torch.tensor([0.5, 1.0, 2.5], dtype=torch.float64)


def network(kind="sigmoid", replicas=(), seed=0):
    generator = rng.stream(seed, "weights")
    settings = {"replicas": replicas, "weight_init": Normal(std=1.0), "generator": generator}
    if kind == "baseline":
        return BatchNormReluNetwork(7, [6, 5], 3, **settings).double()
    dbn = DBN(7, [6, 5], **settings)
    init = Normal(std=1.0)
    return DBNClassifier(dbn, n_classes=3, units=kind, output_init=init, generator=generator).network.double()


def batch(replicas=(), n=13, weight=None):
    v = rng.uniform((*replicas, n, 7), generator=rng.stream(0, "v")).double()
    label = (rng.uniform((*replicas, n), generator=rng.stream(0, "label")) * 3).long()
    return Batch(v, label, 0.7, True, weight)


def dropout(share=0.4, seeds=(0,)):
    return Dropout(share, [rng.stream(seed, "dropout") for seed in seeds])


def gradients(module):
    return {name: p.grad for name, p in module.named_parameters() if p.grad is not None}


def close(found, expected):
    assert found.keys() == expected.keys() != set()
    for name in expected:
        torch.testing.assert_close(found[name], expected[name], rtol=1e-11, atol=1e-12, msg=name)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("replicas", [(), (2,)])
def test_a_class_that_weighs_twice_is_an_image_that_counts_twice(loss, replicas):
    data, heavy, plain = batch(replicas), network(replicas=replicas), network(replicas=replicas)
    step = ClassifierStep(heavy, ClassWeighted(loss, WEIGHTS))
    assert step._closed_form is not None
    step.add_gradient(data)
    losses = loss(plain(data.v), data.label) * WEIGHTS[data.label]
    (0.7 * losses.mean(-1).sum()).backward()
    close(gradients(heavy), gradients(plain))
    total, found, _ = ClassifierStep(network(replicas=replicas), ClassWeighted(loss, WEIGHTS)).loss(data)
    torch.testing.assert_close(found, losses.detach())
    torch.testing.assert_close(total.detach(), 0.7 * losses.mean(-1).sum().detach())


def test_chunks_add_up_to_the_whole():
    whole, parts, data = network(), network(), batch(n=12)
    loss = ClassWeighted(cross_entropy, WEIGHTS)
    ClassifierStep(whole, loss).add_gradient(data._replace(share=1.0))
    for rows, share in ((slice(0, 3), 0.25), (slice(3, 12), 0.75)):
        ClassifierStep(parts, loss).add_gradient(Batch(data.v[rows], data.label[rows], share, True))
    close(gradients(parts), gradients(whole))


def test_balanced_weights_make_classes_count_alike():
    totals = torch.tensor([60, 0, 30, 10])
    found = balanced(totals)
    torch.testing.assert_close(found * totals, torch.tensor([1.0, 0, 1, 1]) * 100 / 3)
    assert found[1] == 1


@pytest.mark.parametrize("weight", [[1.0, 0.0], [1.0, -1.0], [1.0, float("nan")], [[1.0]]])
def test_weights_that_are_none_are_refused(weight):
    with pytest.raises(SettingError, match="class weights"):
        ClassWeighted(cross_entropy, torch.tensor(weight))


def by_hand(module, data, drawn):
    """Logits of a network whose hidden activations are multiplied by these factors, layer by layer."""
    x, left = data.v, list(drawn)
    kinds = (nn.ReLU,) if isinstance(module, BatchNormReluNetwork) else (nn.ReLU, type(DBN(2, [2])[0]))
    layers = [m for m in module.modules() if type(m) in (*kinds, Linear) or type(m).__name__ == "BatchNorm"]
    for layer in layers:
        x = layer(x)
        if isinstance(layer, kinds):
            x = x * left.pop(0)
    assert not left
    return x


@pytest.mark.parametrize("kind", ["sigmoid", "batch_norm_relu", "baseline"])
@pytest.mark.parametrize("replicas", [(), (2,)])
@pytest.mark.parametrize("closed", [True, False])
def test_gradient_with_units_left_out(kind, replicas, closed):
    data, quick, slow = batch(replicas), network(kind, replicas), network(kind, replicas)
    drawn = dropout()
    factors = [drawn.factor(torch.empty(*replicas, 13, n).double()) for n in (6, 5)]
    loss = cross_entropy if closed else lambda logits, label: cross_entropy(logits, label)
    step = ClassifierStep(quick, loss, dropout())
    assert (step._closed_form is not None) == closed
    step.add_gradient(data)
    (0.7 * cross_entropy(by_hand(slow, data, factors), data.label).mean(-1).sum()).backward()
    close(gradients(quick), gradients(slow))


def test_factors_have_their_share_of_zeros_and_keep_the_mean():
    x, drawn = torch.empty(400, 50), dropout(0.3)
    factor = drawn.factor(x)
    assert factor.unique().tolist() == pytest.approx([0, 1 / 0.7])
    assert float((factor == 0).float().mean()) == pytest.approx(0.3, abs=5 * (0.21 / 20_000) ** 0.5)
    assert not factor.equal(drawn.factor(x))
    assert dropout(0.3).factor(x).equal(factor)
    assert dropout(0.0).factor(x).equal(torch.ones(400, 50))


def test_networks_side_by_side_are_left_out_as_each_alone():
    alone = [network("batch_norm_relu", (2,), seed) for seed in (3, 5)]
    together, data = stacked(alone, (2,)), batch((2,))
    both = Batch(data.v.repeat(2, 1, 1), data.label.repeat(2, 1), 0.7, True)
    ClassifierStep(together, cross_entropy, dropout(seeds=(3, 5))).add_gradient(both)
    for module, seed in zip(alone, (3, 5), strict=True):
        ClassifierStep(module, cross_entropy, dropout(seeds=(seed,))).add_gradient(data)
    expected = {name: torch.cat([gradients(module)[name] for module in alone]) for name in gradients(alone[0])}
    close(gradients(together), expected)


def test_a_network_of_other_modules_is_refused():
    other = nn.Sequential(Linear(7, 5), nn.Tanh(), Linear(5, 3))
    with pytest.raises(SettingError, match=r"finetune.dropout = 0.4 .*modules of your own"):
        ClassifierStep(other, cross_entropy, dropout())
    ClassifierStep(other, cross_entropy)


@pytest.mark.parametrize("share", [-0.1, 1.0, 1, True, "half", None])
def test_share_is_a_number_below_one(share):
    with pytest.raises(SettingError, match=r"finetune.dropout = .*\[0, 1\)"):
        dropout(share)
    with pytest.raises(SettingError, match=r"finetune.dropout = .*\[0, 1\)"):
        DBNClassifier(DBN(3, [2]), n_classes=2, dropout=share)
