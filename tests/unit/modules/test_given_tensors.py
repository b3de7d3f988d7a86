"""Tensors and data loaders of tensors in the place of our own batches."""

import math

import lightning.pytorch as pl
import pytest
import torch
from torch.optim import SGD
from torch.utils.data import DataLoader, TensorDataset

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.models.units import Categorical, Gaussian
from memcomp_lightning.modules import Classifier, EnergyPretraining
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import Greedy, finetune, pretrain
from memcomp_lightning.training.given import as_batch, updates_of
from memcomp_lightning.types import Batch

V = rng.bernoulli(torch.full((24, 6), 0.5), generator=rng.stream(0, "rows"))
LABEL = V[:, 0].long()


def sgd(parameters):
    return SGD(parameters, lr=0.1)


def weights_after(batches):
    rbm = RBM(6, 3)
    [*pretrain(Greedy(rbm), batches, CD(k=1), iterations=2, optimizer=sgd)]
    return torch.cat([x.detach().flatten() for x in rbm.parameters()])


def test_a_tensor_is_one_update_a_pass():
    own = [Batch(V, LABEL, share=1.0, closes_step=True)]
    assert torch.equal(weights_after(V), weights_after(own))
    assert torch.equal(weights_after([V]), weights_after(own))
    assert not torch.equal(weights_after([V[:12], V[12:]]), weights_after(own))


def test_a_loader_of_tensors():
    loader = DataLoader(TensorDataset(V), batch_size=8, generator=torch.Generator())
    own = [Batch(part, LABEL[:8], share=1.0, closes_step=True) for part in V.split(8)]
    assert torch.equal(weights_after(loader), weights_after(own))


def test_under_lightning():
    loader = DataLoader(TensorDataset(V), batch_size=8, generator=torch.Generator())
    dbn = DBN(6, [3])
    module = EnergyPretraining(Greedy(dbn), CD(k=1), iterations=2, optimizer=sgd, centring=None)
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    pl.Trainer(max_epochs=2, accelerator="cpu", enable_model_summary=False, **quiet).fit(module, loader, loader)
    found = torch.cat([x.detach().flatten() for x in dbn[0].parameters()])
    torch.testing.assert_close(found, weights_after(loader))


@pytest.mark.usefixtures("allow_global_rng")
def test_a_classifier_takes_pairs():
    network = torch.nn.Linear(6, 2)
    loader = DataLoader(TensorDataset(V, LABEL), batch_size=8, generator=torch.Generator())
    [*finetune(network, loader, iterations=30, optimizer=sgd)]
    assert (network(V).argmax(-1) == LABEL).float().mean() > 0.9
    assert Classifier(network).validation_step([V, LABEL], 0)["score"].accuracy > 0.9


def test_gaps_and_categories():
    v = V.clone()
    v[0, 1] = torch.nan
    batch = as_batch(v)
    assert batch.observed is not None
    assert batch.observed.sum() == v.numel() - 1
    assert not batch.v.isnan().any()
    kept = torch.tensor([[0.0, 2.0], [1.0, torch.nan]])
    batch = as_batch(kept, Categorical([2, 3]))
    assert batch.v.shape == (2, 5)
    assert batch.v[0].tolist() == [1, 0, 0, 0, 1]
    assert batch.observed[1].tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("given", ["rows", [V, LABEL, V], {"v": V}, 3])
def test_anything_else_is_refused(given):
    with pytest.raises(SettingError, match="batch = "):
        as_batch(given)


def test_values_that_the_units_do_not_take_are_refused():
    with pytest.raises(SettingError, match=r"v in column 2, row 5 = 3\.0 is not allowed"):
        [
            *pretrain(
                Greedy(RBM(6, 3)),
                V.index_put((torch.tensor(5), torch.tensor(2)), torch.tensor(3.0)),
                CD(k=1),
                iterations=1,
                optimizer=sgd,
            )
        ]
    with pytest.raises(SettingError, match="is not allowed"):
        as_batch(torch.tensor([[3.0, 0.0]]), Categorical([2, 3]))


def test_other_columns_are_refused():
    with pytest.raises(SettingError, match="columns of a batch = 5 is not allowed: expected 6, the visible units"):
        [*pretrain(Greedy(RBM(6, 3)), V[:, :5], CD(k=1), iterations=1, optimizer=sgd)]
    with pytest.raises(
        SettingError, match="columns of a batch = 12 is not allowed: expected 6, the visible units"
    ):
        [*updates_of(torch.cat([V, V], dim=-1), RBM(6, 3).visible)]
    assert len([*updates_of(V)]) == 1


def test_each_row_of_each_replica_has_a_label() -> None:
    batch = as_batch(V.unflatten(0, (2, 3, 4)))
    assert batch.label.shape == (2, 3, 4)
    assert (batch.label == -1).all()


def test_an_infinite_value_is_refused_beside_a_missing_one() -> None:
    v = torch.tensor([[0.5, math.inf], [math.nan, 1.0]])
    with pytest.raises(SettingError, match=r"v in column 1, row 0 = inf"):
        as_batch(v, Gaussian(2))
