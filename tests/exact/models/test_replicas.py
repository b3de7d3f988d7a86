"""The gradient in closed form against autograd, and networks side by side against networks alone."""

from functools import partial

import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, BatchNormReluNetwork, Linear, Normal, stacked
from memcomp_lightning.modules import DBNClassifier
from memcomp_lightning.samplers import CD, PCD, Exact
from memcomp_lightning.training import (
    LOSSES,
    ClassifierStep,
    Greedy,
    MomentumSchedule,
    cross_entropy,
    finetune,
    pretrain,
    score,
    squared_error,
)
from memcomp_lightning.types import Batch


def classifier(replicas, units="sigmoid", seed=0):
    generator = rng.stream(seed, "weights")
    dbn = DBN(7, [5, 3], replicas=replicas, weight_init=Normal(std=1.0), generator=generator)
    made = DBNClassifier(dbn, n_classes=11, units=units, output_init=Normal(std=1.0), generator=generator)
    return made.network.double()


def batch(replicas, n=13, share=0.7):
    v = rng.uniform((*replicas, n, 7), generator=rng.stream(0, "v")).double()
    label = (rng.uniform((*replicas, n), generator=rng.stream(0, "label")) * 11).long()
    return Batch(v, label, share, True)


@pytest.mark.parametrize("replicas", [(), (2,), (2, 3)])
@pytest.mark.parametrize("kind", ["sigmoid", "batch_norm_relu", "baseline"])
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_gradient_is_that_of_the_mean_loss(loss, kind, replicas):
    def network():
        if kind == "baseline":
            made = BatchNormReluNetwork(7, [5, 3], 11, replicas=replicas, weight_init=Normal(std=1.0))
            return made.double()
        return classifier(replicas, kind)

    data, quick, slow = batch(replicas), network(), network()
    step = ClassifierStep(quick, loss)
    assert step._closed_form is not None
    step.add_gradient(data)
    value, losses, logits = step.loss(data)
    torch.testing.assert_close(losses, loss(slow(data.v), data.label))
    value.backward()  # chunks add up, by either way
    (2 * data.share * score(slow(data.v), data.label, loss).mean_loss.sum()).backward()
    torch.testing.assert_close(value, data.share * score(slow(data.v), data.label, loss).mean_loss.sum())
    torch.testing.assert_close(logits, slow(data.v), rtol=1e-12, atol=1e-13)
    for (name, p), q in zip(quick.named_parameters(), slow.parameters(), strict=True):
        assert (p.grad is None) == (q.grad is None), name
        if q.grad is not None:
            torch.testing.assert_close(p.grad, q.grad, rtol=1e-12, atol=1e-13, msg=name)


def test_closed_form_is_taken_where_it_exists():
    closed = [classifier((2,)), classifier((2,), "batch_norm_relu"), BatchNormReluNetwork(7, [5], 11)]
    others = [nn.Identity(), nn.Sequential(Linear(7, 5), Linear(5, 11)), DBN(7, [11]), nn.Sequential()]
    assert all(ClassifierStep(network)._closed_form is not None for network in closed)
    assert all(ClassifierStep(network)._closed_form is None for network in others)
    assert ClassifierStep(closed[0], lambda logits, label: logits[..., 0])._closed_form is None
    frozen, hooked = classifier((2,), "batch_norm_relu"), classifier((2,))
    frozen[0].eval()
    hooked[1].register_forward_hook(lambda *_: None)
    assert all(ClassifierStep(network)._closed_form is None for network in (frozen, hooked))


def test_losses_are_their_formulas():
    logits, label = batch((2,)).v.double(), batch((2,)).label % 7
    by_hand = -torch.log_softmax(logits, -1).gather(-1, label.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(cross_entropy(logits, label), by_hand)
    target = (torch.arange(7) == label.unsqueeze(-1)).double()
    torch.testing.assert_close(squared_error(logits, label), 0.5 * (logits.sigmoid() - target).pow(2).sum(-1))


@pytest.mark.parametrize("n", [1, 13])
def test_running_statistics_of_batch_normalisation_move_as_in_the_module(n):
    quick, slow = (classifier((2, 3), "batch_norm_relu") for _ in range(2))
    data = batch((2, 3), n)
    ClassifierStep(quick).add_gradient(data)
    score(slow(data.v), data.label).mean_loss.sum().backward()
    for name, buffer in slow.named_buffers():
        torch.testing.assert_close(quick.get_buffer(name), buffer, rtol=1e-12, atol=1e-13, msg=name)
    torch.testing.assert_close(
        next(quick.parameters()).grad, 0.7 * next(slow.parameters()).grad, rtol=1e-12, atol=1e-13
    )


class _Reads(TorchDispatchMode):
    """Counts what makes the host wait for a device: values read back, shapes that depend on them, copies."""

    WAITING = ("_local_scalar_dense", "nonzero", "equal", "masked_select", "_to_copy", "copy_from")

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        if name in self.WAITING and not (name == "_to_copy" and "device" not in (kwargs or {})):
            self.found.append(name)
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("sampler", [CD(k=2), PCD(n_chains=5), Exact()], ids=lambda s: type(s).__name__)
def test_no_update_reads_anything_back(sampler):
    """More passes, no more reads: on a GPU the host runs ahead of the device through the whole training."""
    reads = []
    for iterations in (2, 7):
        network, data = classifier((2,)), batch((2,))
        batches = Batches(data.v, data.label, batch_size=5, chunk_size=10, shuffle=True, seed=0)
        settings = {"optimizer": partial(torch.optim.SGD, lr=0.1), "schedules": [MomentumSchedule()]}
        with _Reads() as mode:
            list(pretrain(Greedy(network[0]), batches, sampler, iterations=iterations, **settings))
            list(finetune(network, batches, iterations=iterations, **settings))
        reads.append(sorted(mode.found))
    assert reads[0] == reads[1] != []  # what is left is the check at the end


@pytest.mark.parametrize("units", ["sigmoid", "batch_norm_relu"])
@pytest.mark.parametrize("replicas", [(), (2,)])
def test_stacked_networks_answer_as_each_alone(replicas, units):
    alone = [classifier(replicas, units, seed) for seed in (3, 5, 8)]
    together = stacked(alone, replicas)
    for network in (*alone, together):
        network.eval()
    data = batch(replicas)
    n_replicas = 3 * (replicas[0] if replicas else 1)
    v = torch.stack([data.v] * 3).reshape(n_replicas, *data.v.shape[-2:])
    expected = torch.stack([network(data.v) for network in alone])
    torch.testing.assert_close(together(v), expected.reshape(n_replicas, 13, 11), rtol=1e-12, atol=1e-13)
    with torch.no_grad():
        next(together.parameters()).zero_()
    assert next(alone[0].parameters()).abs().max() > 0


def test_stacking_refuses_other_shapes():
    with pytest.raises(SettingError, match="networks of one shape"):
        stacked([classifier((2,)), classifier((3,))], (2,))
