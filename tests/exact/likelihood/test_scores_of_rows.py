"""Scores of rows: in the user's units, of what is observed, exact or with an error that holds."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import ImageSchema, Schema
from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Real
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.likelihood import annealing_products, log_partition_function
from memcomp_lightning.models import DBN, RBM, BoltzmannMachine
from memcomp_lightning.models.units import Bernoulli, Spin
from memcomp_lightning.testing import brute_force, small_machine, small_machines, small_rbm
from memcomp_lightning.trained import Run, partition
from memcomp_lightning.trained.partition import Annealing, log_z_of
from memcomp_lightning.trained.scoring import score

LABEL = Category("kind", ("cat", "dog"))
SCHEMA = TableSchema(
    (Real("x", 5.0, 10.0), Binary("a", ("no", "yes")), Category("c", (1, 2, 3)), Real("y", 0.0, 0.5)), LABEL
)


def run_of(model: nn.Module, schema: Schema = SCHEMA, classifier: nn.Module | None = None) -> Run:
    return Run(Path("run"), model, classifier, schema)


def rbm() -> RBM:
    """Sites: a, c, x, y."""
    return small_rbm(visible=SCHEMA.units(), hidden=Bernoulli(4))


def rows(*, gaps: bool) -> Rows:
    v = torch.tensor([[1.0, 2.0, 0.3, -1.2], [0.0, 0.0, 1.1, 0.4], [1.0, 1.0, -2.0, 0.0], [0.0, 2.0, 0.0, 0.9]])
    observed = torch.ones_like(v, dtype=torch.bool)
    if gaps:
        observed[1, 2] = observed[2, 1] = observed[2, 3] = False
        observed[3] = False
    return Rows(torch.where(observed, v, 0.0), torch.tensor([0, 1, 1, -1]), observed if gaps else None)


def exact_log_likelihood(model: RBM, given: Rows) -> Tensor:
    """In the user's units, by sums over all states."""
    units = model.visible
    observed = torch.ones_like(given.v, dtype=torch.bool) if given.observed is None else given.observed
    found = brute_force.log_likelihood(model.double(), units.encode(given.v), units.over_sites(observed))
    scales = torch.tensor([0.0, 0.0, math.log(10.0), math.log(0.5)])
    return (found - observed.double() @ scales.double()).detach()


@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "with gaps"])
def test_log_likelihoods_are_densities_in_the_units_of_the_table(gaps: bool) -> None:
    model = rbm()
    found = score(run_of(model), rows(gaps=gaps))
    assert found.log_z is not None
    assert found.log_z.ais is None
    assert "log_likelihood_error" not in found.columns
    exact = exact_log_likelihood(model, rows(gaps=gaps)).numpy()
    assert found.columns["log_likelihood"] == pytest.approx(exact, abs=1e-5)
    assert found.columns["row"].tolist() == [1, 2, 3, 4]
    assert found.accuracy is None
    pseudo = found.columns["pseudo_log_likelihood"]
    assert np.isnan(pseudo).tolist() == [False, gaps, gaps, gaps]
    # Each site given all others, from the likelihood with and without it.
    whole, observed = rows(gaps=False), torch.ones(4, 4, dtype=torch.bool)
    conditionals = []
    for site in range(4):
        mask = observed.clone()
        mask[:, site] = False
        without = Rows(whole.v, whole.label, mask)
        conditionals.append(exact_log_likelihood(model, whole) - exact_log_likelihood(model, without))
    assert pseudo[0] == pytest.approx(float(sum(conditionals)[0]), abs=1e-5)


def test_free_energies_are_in_the_units_of_the_model() -> None:
    found = score(run_of(rbm()), rows(gaps=True)).columns
    wider = replace(SCHEMA, columns=(replace(SCHEMA.columns[0], scale=20.0), *SCHEMA.columns[1:]))  # type: ignore[type-var]
    other = score(run_of(rbm(), wider), rows(gaps=True)).columns
    assert other["free_energy"] == pytest.approx(found["free_energy"])
    moved = np.array([1.0, 0.0, 1.0, 0.0]) * math.log(2)  # where x is observed
    assert other["log_likelihood"] == pytest.approx(found["log_likelihood"] - moved)


@pytest.mark.parametrize("many", [False, True], ids=["few hidden units", "many"])
def test_estimates_are_within_their_errors(monkeypatch: pytest.MonkeyPatch, many: bool) -> None:
    """Where nothing is enumerated: AIS from both sides, and of rows with gaps for each of them."""
    monkeypatch.setattr(partition, "MOST_OTHERS", 0)
    model = rbm()
    if many:  # the same likelihoods, with hidden units that do nothing
        wide = RBM(visible=SCHEMA.units(), hidden=Bernoulli(20))
        with torch.no_grad():
            for name, parameter in wide.named_parameters():
                parameter.zero_()
                own = dict(model.named_parameters())[name]
                parameter[tuple(slice(n) for n in own.shape)] = own
        model_of_rows, exact = wide, exact_log_likelihood(model, rows(gaps=True))
    else:
        model_of_rows, exact = rbm(), exact_log_likelihood(model, rows(gaps=True))
    found = score(run_of(model_of_rows), rows(gaps=True), annealing=Annealing(n_betas=200), seed=1)
    assert found.log_z is not None
    assert found.log_z.trusted
    assert "by AIS (200 steps, " in str(found.log_z)
    assert "from the other side" in str(found.log_z)
    off, error = found.columns["log_likelihood"] - exact.numpy(), found.columns["log_likelihood_error"]
    assert (np.abs(off) < 4 * error + 1e-5).all()
    assert (error < 0.1).all()
    assert error[0] == pytest.approx(found.log_z.error)
    assert (error[1:] > error[0]).all() == many


def test_steps_grow_until_enough_chains_are_effective(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(partition, "MOST_BITS", 0)
    model = small_rbm(visible=Spin(12), hidden=Spin(8))
    with torch.no_grad():
        model.weight.mul_(4)
    poor = log_z_of(model, annealing=Annealing(n_betas=1, most_betas=3))
    assert poor.n_betas == 1
    assert not poor.trusted
    better = log_z_of(model, annealing=Annealing(n_betas=1, most_betas=256))
    assert better.n_betas in (16, 64, 256)
    assert abs(better.value - float(log_partition_function(model))) < 4 * better.error


def test_machines_of_any_connectivity_are_annealed_both_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(partition, "MOST_BITS", 0)
    monkeypatch.setattr(partition, "MOST_OTHERS", 0)
    monkeypatch.setattr(partition, "_samples", partial(partition._samples, n_sweeps=100))
    model = small_machine(visible=Spin(6), hidden=Bernoulli(4))
    with torch.no_grad():
        model.coupling.mul_(3)
    settings = Annealing(n_betas=1, most_betas=256)
    found = log_z_of(model, annealing=settings)
    assert found.n_betas > 1
    assert found.trusted
    assert "from the other side" in str(found)
    assert abs(found.value - float(log_partition_function(model))) < 4 * found.error
    n_products = annealing_products(model, settings.n_chains, found.n_betas)
    monkeypatch.setattr(partition, "MOST_PRODUCTS", n_products - 1)
    assert log_z_of(model, annealing=settings).n_betas == found.n_betas // 4
    monkeypatch.setattr(partition, "MOST_PRODUCTS", 1)
    with pytest.raises(UserError, match="would take minutes to anneal"):
        log_z_of(model, annealing=settings)


@pytest.mark.parametrize("make", small_machines().values(), ids=small_machines())
def test_machines_have_scores_too(make: Any) -> None:
    model = make()

    class Sites(ImageSchema):
        """Any units, read as numbers of their sites."""

        def units(self) -> Any:
            return model.visible

    schema = Sites(PixelLayout(1, model.visible.n_sites), 0)
    v = torch.ones(2, model.visible.n_sites)
    observed = torch.ones_like(v, dtype=torch.bool)
    observed[1, 0] = False
    found = score(run_of(model, schema), Rows(v, torch.full((2,), -1), observed))
    masks = model.visible.over_sites(observed)
    exact = brute_force.log_likelihood(model.double(), model.visible.encode(v), masks).detach().numpy()
    of_rows = found.columns["log_likelihood"]
    assert of_rows[0] == pytest.approx(exact[0], abs=1e-5)
    assert of_rows[1] == pytest.approx(exact[1], abs=1e-5)


def test_rows_of_a_potts_model_with_many_gaps_have_no_likelihood_and_are_counted() -> None:
    model = BoltzmannMachine(n_visible=13, n_hidden=0)
    v = torch.ones(3, 13)
    observed = torch.ones_like(v, dtype=torch.bool)
    observed[1, :11] = observed[2, :10] = False
    found = score(run_of(model, ImageSchema(PixelLayout(1, 13), 0)), Rows(v, torch.full((3,), -1), observed))
    assert np.isnan(found.columns["log_likelihood"]).tolist() == [False, True, False]
    assert any(note.startswith("1 rows with gaps have no likelihood: more than 1,024") for note in found.notes)


def only_first(value: float) -> Rows:
    """A row of which the first entry alone is known."""
    v, observed = torch.zeros(1, 4), torch.zeros(1, 4, dtype=torch.bool)
    v[0, 0], observed[0, 0] = value, True
    return Rows(v, torch.tensor([-1]), observed)


class Fixed(nn.Module):
    """Logits that follow the first two entries."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))

    def forward(self, v: Tensor) -> Tensor:
        return self.scale * torch.stack((v[:, 0], 1 - v[:, 0]), dim=-1)


def test_classes_are_those_of_the_classifier() -> None:
    found = score(run_of(rbm(), classifier=Fixed()), rows(gaps=False))
    p = 1 / (1 + math.exp(-1))
    assert found.columns["p(cat)"] == pytest.approx([p, 1 - p, p, 1 - p])
    assert found.columns["class"].tolist() == ["cat", "dog", "cat", "dog"]
    assert found.accuracy == pytest.approx(2 / 3)  # the last one has no label
    found = score(run_of(rbm(), classifier=Fixed()), rows(gaps=True))
    assert found.notes == ["classes of 3 rows with gaps: means over 100 draws of what is missing"]
    assert found.columns["p(cat)"] + found.columns["p(dog)"] == pytest.approx(1)
    assert found.accuracy == pytest.approx(2 / 3)
    # What the first two entries do not say, nobody need know; where nothing is known, the first is 1 as often as
    # the model has it.
    on = float(exact_log_likelihood(rbm(), only_first(1.0)).exp())
    assert found.columns["p(cat)"] == pytest.approx([p, 1 - p, p, p * on + (1 - p) * (1 - on)], abs=0.05)
    assert 0.1 < on < 0.9
    again = score(run_of(rbm(), classifier=Fixed()), rows(gaps=True)).columns
    assert (again["p(cat)"] == found.columns["p(cat)"]).all()
    other = score(run_of(rbm(), classifier=Fixed()), rows(gaps=True), seed=1).columns
    assert (other["p(cat)"] != found.columns["p(cat)"]).tolist() == [False, False, False, True]


def test_classes_of_rows_with_gaps_know_both_modes() -> None:
    """Two modes that sweeps do not leave: all entries 0, or all 1 with .8 of the weight; nothing is known."""
    schema = TableSchema(tuple(Binary(name, ("no", "yes")) for name in "abcd"), LABEL)
    model = RBM(visible=schema.units(), n_hidden=2)
    with torch.no_grad():
        model.weight[:], model.b[:] = 14.0, -14.0
        model.c[:] = -28.0 + math.log(4) / 2
    states = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 4)
    weight = torch.softmax(-model.free_energy(states).double(), 0)
    exact = float((weight * torch.softmax(Fixed()(states), -1)[:, 0]).sum().detach())
    nothing = Rows(torch.zeros(1, 4), torch.tensor([-1]), torch.zeros(1, 4, dtype=torch.bool))
    run = run_of(model, schema, Fixed())
    found = [score(run, nothing, seed=seed).columns["p(cat)"][0] for seed in range(5)]
    assert exact == pytest.approx(0.8 / (1 + math.exp(-1)) + 0.2 / (1 + math.e), abs=1e-3)
    assert np.mean(found) == pytest.approx(exact, abs=0.05)


def test_without_a_model_of_the_data_nothing_fills_the_inputs_of_a_classifier() -> None:
    alone = replace(run_of(DBN(None, [3], visible=SCHEMA.units()), classifier=Fixed()), pretrained=False)
    found = score(alone, rows(gaps=True))
    assert found.columns["class"].tolist() == ["cat", None, None, None]
    assert np.isnan(found.columns["p(dog)"]).tolist() == [False, True, True, True]
    assert found.accuracy == 1.0
    assert found.notes[1] == "3 rows with gaps have no class: this run was not pretrained, so nothing fills them"


def test_the_first_layer_of_a_stack_fills_the_inputs_of_a_classifier() -> None:
    stack = DBN(None, [3, 2], visible=SCHEMA.units())
    with torch.no_grad():
        stack[0].b[0] = 4.0  # the first entry is 1
    found = score(run_of(stack, classifier=Fixed()), rows(gaps=True)).columns
    assert found["class"].tolist() == ["cat", "dog", "cat", "cat"]
    assert found["p(cat)"][3] > 0.7


def test_a_network_without_an_energy_has_classes_alone() -> None:
    stack = DBN(None, [3, 2], visible=SCHEMA.units())
    found = score(run_of(stack, classifier=Fixed()), rows(gaps=False))
    assert list(found.columns) == ["row", "p(cat)", "p(dog)", "class"]
    assert found.notes[0].startswith("no likelihoods: run is a deep belief network of 2 layers")
    with pytest.raises(UserError, match="deep belief network of 2 layers"):
        score(run_of(stack), rows(gaps=False))


def test_grey_values_have_no_likelihood() -> None:
    schema = ImageSchema(PixelLayout(2, 2), 2)
    grey = Rows(torch.full((3, 4), 0.5), torch.full((3,), -1))
    model = small_rbm(visible=Bernoulli(4), hidden=Bernoulli(2))
    with pytest.raises(SettingError, match="binarise the images"):
        score(run_of(model, schema), grey)
    found = score(run_of(model, schema, Fixed()), grey)
    assert list(found.columns) == ["row", "p(0)", "p(1)", "class"]
    assert "binarise the images" in found.notes[0]
    assert list(score(run_of(model, schema), Rows(grey.v.round(), grey.label)).columns)[1] == "log_likelihood"


def test_nothing_known_is_certain() -> None:
    """Without any observed value log p is 0."""
    given = rows(gaps=True)
    nothing = given._replace(observed=torch.zeros_like(given.observed))
    found = score(run_of(rbm()), nothing).columns
    assert found["log_likelihood"] == pytest.approx(0, abs=1e-6)
