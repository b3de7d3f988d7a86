"""Rows drawn from a model, cells masked at random: probabilities and intervals hold as often as they say."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Real, SpinColumn
from memcomp_lightning.likelihood import exact_samples
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.models.units import Bernoulli
from memcomp_lightning.trained import Run
from memcomp_lightning.trained.gaps import SiteGaps
from memcomp_lightning.trained.imputation import Imputation, impute

MASKED = 0.3
SCHEMA = TableSchema(
    (
        Binary("a", ("no", "yes")),
        Real("x", 30.0, 8.0),
        Category("c", ("blue", "green", "red")),
        SpinColumn("s"),
        Real("y", 0.0, 1.0),
        Category("d", (0, 1, 2, 3)),
        Real("z", -5.0, 0.1),
    )
)


def run_of(n_hidden: int, *, size: float) -> Run:
    """Hidden bits that split real columns into clusters some standard deviations apart."""
    generator = rng.stream(0, "test model")
    init = Normal(std=size)
    rbm = RBM(visible=SCHEMA.units(), hidden=Bernoulli(n_hidden), weight_init=init, generator=generator)
    with torch.no_grad():
        # Hidden bits are on about half of the time.
        rbm.b.copy_(Normal(std=0.5)((1, rbm.n_visible), generator=generator)[0] - rbm.weight.sum(0) / 2)
        rbm.c.copy_(-(rbm.weight @ rbm.visible.mean(rbm.weight.sum(0) / 2 + rbm.b)))
    return Run(Path("run"), rbm, schema=SCHEMA)


def masked(run: Run, n: int) -> tuple[Tensor, Rows]:
    """The truth, and the same rows with a share of the cells masked."""
    v = exact_samples(run.model, n, generator=rng.stream(0, "truth"))
    units = SCHEMA.units()
    kept = [v[:, units.site_of() == site] for site in range(units.n_sites)]
    truth = torch.stack([part.argmax(-1).float() if part.shape[1] > 1 else part[:, 0] for part in kept], dim=-1)
    observed = rng.uniform(truth.shape, generator=rng.stream(0, "mask")) > MASKED
    return truth, Rows(torch.where(observed, truth, 0.0), torch.full((n,), -1), observed)


@pytest.fixture(scope="module", params=[(6, 1.4, 1500), (13, 0.6, 600)], ids=["sums", "chains"])
def found(request: pytest.FixtureRequest) -> tuple[Tensor, Imputation]:
    n_hidden, size, n = request.param
    run = run_of(n_hidden, size=size)
    truth, rows = masked(run, n)
    imputed = impute(run, rows, m=5)
    assert bool(imputed.r_hat.isfinite().any()) == (n_hidden > 12)
    return truth, imputed


def standard_errors(events: Tensor, probabilities: Tensor) -> float:
    """How far a number of events is from what was stated."""
    p = probabilities.double()
    return abs(float(events.double().sum() - p.sum())) / math.sqrt(float((p * (1 - p)).sum()) + 1e-12)


def of_real(imputed: Imputation) -> list[SiteGaps]:
    return [gaps for gaps in imputed.gaps if gaps.states is None]


def test_nine_in_ten_intervals_hold_the_real_value(found: tuple[Tensor, Imputation]) -> None:
    truth, imputed = found
    within, narrow = [], []
    for gaps in of_real(imputed):
        value = truth[gaps.row, gaps.site]
        assert gaps.low is not None
        assert gaps.high is not None
        within.append((gaps.low <= value) & (value <= gaps.high))
        # What a unit spreads about its mean given one hidden state: 3.3 standard deviations.
        narrow.append((value - gaps.value).abs() < 1.645)
    share = float(torch.cat(within).double().mean())
    assert 0.85 <= share <= 0.95
    assert float(torch.cat(narrow).double().mean()) < 0.8


def test_values_lie_about_the_mean_as_the_deviation_says(found: tuple[Tensor, Imputation]) -> None:
    truth, imputed = found
    z = torch.cat([(truth[gaps.row, gaps.site] - gaps.value) / gaps.deviation for gaps in of_real(imputed)])
    for off in (z, z.square() - 1):
        assert abs(float(off.mean())) < 4 * float(off.std()) / math.sqrt(len(z))


def test_stated_probabilities_are_those_of_the_values(found: tuple[Tensor, Imputation]) -> None:
    """In every fifth from 0 to 1 as many states are the true ones as was said."""
    truth, imputed = found
    stated, true = [], []
    for gaps in imputed.gaps:
        if gaps.states is not None and gaps.probability is not None:
            assert gaps.probability.sum(-1).allclose(torch.ones(1))
            stated.append(gaps.probability.flatten())
            true.append((truth[gaps.row, gaps.site].unsqueeze(-1) == gaps.states).flatten())
    p, hit = torch.cat(stated), torch.cat(true)
    for fifth in range(5):
        some = (p >= fifth / 5) & (p < (fifth + 1) / 5)
        assert int(some.sum()) > 5
        assert standard_errors(hit[some], p[some]) < 4.5
    right = torch.cat([truth[g.row, g.site] == g.value for g in imputed.gaps if g.states is not None])
    of_value = torch.cat([g.of_value for g in imputed.gaps if g.states is not None])
    assert standard_errors(right, of_value) < 4.5
    assert imputed.mean_probability == pytest.approx(float(right.double().mean()), abs=0.03)


def test_draws_are_spread_as_the_truth_is(found: tuple[Tensor, Imputation]) -> None:
    """The true value is anywhere among five draws, and two values of a row are drawn together."""
    truth, imputed = found
    rank = torch.cat([(gaps.draws < truth[gaps.row, gaps.site]).sum(0) for gaps in of_real(imputed)])
    counts = torch.bincount(rank, minlength=6).double()
    expected = len(rank) / 6
    assert float(((counts - expected).square() / expected).sum()) < 25  # chi-square of 5: p is 1e-4
    x, y = ([s.name for s in SCHEMA.of_sites].index(name) for name in ("x", "y"))
    both = ~imputed.rows.observed[:, [x, y]].any(-1)  # type: ignore[index]
    product = torch.stack([imputed.completed(draw)[both][:, [x, y]].prod(-1) for draw in range(5)]).mean(0)
    off = truth[both][:, [x, y]].prod(-1) - product
    assert abs(float(off.mean())) < 4 * float(off.std()) / math.sqrt(len(off))
