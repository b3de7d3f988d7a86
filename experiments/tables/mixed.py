"""Held-out log-likelihood, and samples beside held-out rows, of RBMs of tables and of mixtures.

A table of bits, categories and real numbers whose density is known, and two tables of real numbers that ship with
scikit-learn. Densities are those of the user's columns, whatever the columns are scaled to in between.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from conditional_gaussian import MixedTable
from fitting import AS_TYPED, Chosen, Settings, choose, read, trained
from marginals import agreement
from medians import shown
from mixture_of_classes import Classes, States, fit
from numpy.typing import NDArray
from sklearn.datasets import load_breast_cancer, load_wine
from sklearn.mixture import GaussianMixture
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.tables import TableData
from memcomp_lightning.data.tables.columns import Words
from memcomp_lightning.samplers import ParallelTempering
from memcomp_lightning.trained.partition import Annealing, LogZ
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.sampling import sample
from memcomp_lightning.trained.scoring import score

SEEDS, TUNING = (0, 1, 2, 3, 4, 5), 100
N_SAMPLES = 10_000
QUICKLY = Annealing(n_betas=500, most_betas=500)
"""Where settings are compared; what stands in the table is annealed as memcomp-score does."""

SHIPPED = {"breast cancer": load_breast_cancer, "wine": load_wine}
LOOKS = 6
"""How often a model is looked at in its training: it is taken where validation rows are likeliest."""
OF_MIXED = [Settings(n_hidden=n, rate=rate, passes=90) for n in (8, 16, 50) for rate in (0.1, 0.2, 0.4)]
OF_SHIPPED = [Settings(n_hidden=n, rate=rate, passes=300) for n in (16, 64) for rate in (0.05, 0.1)]
TEMPERED = "RBM, trained with parallel tempering"
CLASSES = (2, 4, 6, 8, 12, 16, 24)
COMPONENTS, COVARIANCES, LEAST = (1, 2, 3, 4, 6, 8, 10), ("full", "tied", "diag", "spherical"), (1e-6, 1e-3, 1e-2)


class Sizes(NamedTuple):
    """Rows of each part of a made table."""

    train: int = 2000
    validation: int = 1000
    test: int = 10_000


class Model(NamedTuple):
    """What a method made of one table.

    Attributes:
        log_likelihood: Mean of the test rows; None of what has none.
        v: Samples as numbers of the sites, ``(n, n_sites)``; None of what draws none.
        settings: That were chosen.
        log_z: How log Z was found; None of models that need none.
        drawn: How the samples were.
    """

    log_likelihood: float | None
    v: Tensor | None
    settings: str = ""
    log_z: LogZ | None = None
    drawn: str = ""


class Split(NamedTuple):
    """A table in three parts.

    Attributes:
        table: As memcomp_lightning reads it.
        truth: Mean log density of the test rows; None where it is not known.
        seed: Of rows or of the split.
    """

    table: TableData
    truth: float | None
    seed: int


def mixed_table(seed: int, sizes: Sizes) -> Split:
    """A distribution and rows of it."""
    generator = rng.numpy_stream(seed, "mixed")
    known = MixedTable.draw(generator)
    parts = {name: known.sample(n, generator) for name, n in sizes._asdict().items()}
    return Split(_read(parts), float(known.log_density(parts["test"]).mean()), seed)


def shipped_table(name: str, seed: int) -> Split:
    """A random fifth of the rows to test, and one for validation."""
    frame = SHIPPED[name](as_frame=True).data
    order = rng.numpy_stream(seed, f"split of {name}").permutation(len(frame))
    first, second = round(0.6 * len(frame)), round(0.8 * len(frame))
    parts = {"train": order[:first], "validation": order[first:second], "test": order[second:]}
    return Split(_read({part: frame.iloc[rows] for part, rows in parts.items()}), None, seed)


def _read(parts: dict[str, pd.DataFrame]) -> TableData:
    with tempfile.TemporaryDirectory() as folder:
        return read(Path(folder), **parts)


# ------------------------------------------------------------------------------------------------ the models


def on_validation(table: TableData) -> Callable[[Run], float]:
    """Mean log-likelihood of validation rows."""
    rows = table.validation
    assert rows is not None
    return lambda run: float(score(run, rows, pseudo=False, annealing=QUICKLY).columns["log_likelihood"].mean())


def independent(split: Split, n_samples: int) -> Model:
    """Each column by itself: frequencies of values, one more of each, or a normal distribution."""
    table, generator = split.table, rng.numpy_stream(split.seed, "independent")
    train, test = (part.v.double().numpy() for part in (table.train, table.test))
    log_p, drawn = np.zeros(len(test)), np.empty((n_samples, train.shape[1]))
    for site, column in enumerate(table.schema.of_sites):
        if isinstance(column, Words):
            counts = np.bincount(train[:, site].astype(int), minlength=len(column.words)) + 1.0
            share = counts / counts.sum()
            log_p += np.log(share[test[:, site].astype(int)])
            drawn[:, site] = generator.choice(len(share), n_samples, p=share)
        else:
            mean, deviation = train[:, site].mean(), train[:, site].std()
            log_p -= ((test[:, site] - mean) / deviation) ** 2 / 2 + np.log(deviation) + np.log(2 * np.pi) / 2
            drawn[:, site] = generator.normal(mean, deviation, n_samples)
    return Model(float(log_p.mean()) - table.schema.log_scale, torch.tensor(drawn))


def gaussian_mixture(components: Sequence[int], split: Split, n_samples: int) -> Model:
    """By EM, of the components, covariances and floor of variances that are best on validation rows."""
    table = split.table
    assert table.validation is not None
    train, validation, test = (part.v.double().numpy() for part in (table.train, table.validation, table.test))
    best = max(
        (
            GaussianMixture(k, covariance_type=kind, reg_covar=least, random_state=split.seed).fit(train)
            for k in components
            for kind in COVARIANCES
            for least in LEAST
        ),
        key=lambda model: float(model.score(validation)),
    )
    log_p = float(best.score(test)) - table.schema.log_scale
    return Model(log_p, torch.tensor(best.sample(n_samples)[0]), f"{best.n_components} {best.covariance_type}")


def as_numbers(table: TableData, v: Tensor) -> tuple[States, NDArray[np.float64]]:
    """States of the columns of words, and the numbers of the others."""
    words, values = _are_words(table), v.double().numpy()
    return values[:, words].astype(int), values[:, ~words]


def mixture(split: Split, k: int) -> Classes:
    """Of k classes, fitted to the training rows."""
    sizes = [len(column.words) for column in split.table.schema.of_sites if isinstance(column, Words)]
    parts = as_numbers(split.table, split.table.train.v)
    return fit(*parts, sizes, n_classes=k, generator=rng.numpy_stream(split.seed, "mixture"))


def classes_on(split: Split) -> int:
    """How many classes are best on the validation rows."""
    assert split.table.validation is not None
    parts = as_numbers(split.table, split.table.validation.v)
    return max(CLASSES, key=lambda k: float(mixture(split, k).log_density(*parts).mean()))


def of_mixture(k: int, split: Split, n_samples: int) -> Model:
    """A mixture whose number of classes is known."""
    table, found = split.table, mixture(split, k)
    log_p = float(found.log_density(*as_numbers(table, table.test.v)).mean()) - table.schema.log_scale
    words, drawn = _are_words(table), np.empty((n_samples, table.train.v.shape[1]))
    drawn[:, words], drawn[:, ~words] = found.sample(n_samples, rng.numpy_stream(split.seed, "of the mixture"))
    return Model(log_p, torch.tensor(drawn))


def _are_words(table: TableData) -> NDArray[np.bool_]:
    return np.array([isinstance(column, Words) for column in table.schema.of_sites])


def of_run(run: Run, split: Split, n_samples: int, settings: str) -> Model:
    """A trained model."""
    found, drawn = score(run, split.table.test, pseudo=False), sample(run, n_samples, seed=split.seed)
    mean = float(found.columns["log_likelihood"].mean())
    return Model(mean, drawn.v, settings, found.log_z, drawn.mixing.method)


def as_typed(settings: Settings, split: Split, n_samples: int) -> Model:
    """At settings that nobody chose."""
    *_, (_, run) = trained(split.table, settings, seed=split.seed)
    return of_run(run, split, n_samples, "")


def with_settings(chosen: Chosen, split: Split, n_samples: int) -> Model:
    """Trained anew as was best on another table."""
    runs = trained(split.table, chosen.settings, seed=split.seed, looks=LOOKS)
    run = next(run for passes, run in runs if passes == chosen.passes)
    return of_run(run, split, n_samples, "")


def chosen_here(grid: Sequence[Settings], split: Split, n_samples: int) -> Model:
    """The best on the table's own validation rows."""
    best = choose(split.table, grid, on_validation(split.table), seed=split.seed, looks=LOOKS)
    return of_run(best.run, split, n_samples, f"{best.settings.n_hidden} ({best.settings.rate:g}, {best.passes})")


def training_rows(split: Split, n_samples: int) -> Model:
    """What held-out rows have in common with these is what noise leaves."""
    return Model(None, split.table.train.v)


def truth(split: Split, n_samples: int) -> Model:
    return Model(split.truth, None)


Method = Callable[[Split, int], Model]


def row_of(models: Sequence[Model], splits: Sequence[Split], base: Sequence[Model]) -> dict[str, Any]:
    """Numbers of the page: medians over the seeds, of likelihoods beside those of independent columns."""
    means = [model.log_likelihood for model in models if model.log_likelihood is not None]
    gain = [mean - one.log_likelihood for mean, one in zip(means, base) if one.log_likelihood is not None]  # noqa: B905
    near = [
        agreement(model.v, split.table.test.v, split.table.schema)
        for model, split in zip(models, splits, strict=True)
        if model.v is not None
    ]
    return {
        "log-likelihood": shown(means, 2) if means else "",
        "above independent columns": shown(gain, 2) if gain else "",
        "log Z": of_log_z([model.log_z for model in models if model.log_z is not None]),
        "correlations": shown([one.correlations for one in near]) if near else "",
        "marginal": shown([one.marginal for one in near]) if near else "",
        "samples": ", ".join(dict.fromkeys(model.drawn for model in models if model.drawn)),
    }


def of_log_z(found: Sequence[LogZ]) -> str:
    """How log Z was found: of AIS the largest standard error, and how far it is at most from reverse AIS."""
    annealed = [one for one in found if one.ais is not None]
    if not annealed:
        return "exact" if found else ""
    apart = [abs(float(one.reverse.log_z) - one.value) for one in annealed if one.reverse is not None]
    error = f"AIS ± {max(one.error for one in annealed):.2f}, reverse within {max(apart):.2f}"
    return error if len(annealed) == len(found) else f"{error}; {len(found) - len(annealed)} of {len(found)} exact"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is run: tables, and the settings that are compared on validation rows."""

    seeds: Sequence[int] = SEEDS
    sizes: Sizes = field(default_factory=Sizes)
    n_samples: int = N_SAMPLES
    typed: Settings = AS_TYPED
    of_mixed: Sequence[Settings] = field(default_factory=lambda: OF_MIXED)
    shipped: Sequence[str] = field(default_factory=lambda: list(SHIPPED))
    of_shipped: Sequence[Settings] = field(default_factory=lambda: OF_SHIPPED)
    components: Sequence[int] = COMPONENTS


def made(plan: Plan) -> Iterator[dict[str, Any]]:
    """Rows of the table whose density is known; settings are chosen on another such table."""
    n_samples = plan.n_samples
    tuning, splits = mixed_table(TUNING, plan.sizes), [mixed_table(seed, plan.sizes) for seed in plan.seeds]
    base = [independent(split, n_samples) for split in splits]
    k = classes_on(tuning)
    fixed: dict[str, tuple[Method, str]] = {
        "independent columns": (independent, ""),
        "mixture of classes": (partial(of_mixture, k), f"{k} classes"),
        "RBM at the defaults of 0.2": (partial(as_typed, plan.typed), f"{plan.typed}, {plan.typed.passes} passes"),
    }
    for name, (method, settings) in fixed.items():
        models = [method(split, n_samples) for split in splits]
        yield {"table": "mixed", "model": name, **row_of(models, splits, base), "settings": settings}
    best = choose(tuning.table, plan.of_mixed, on_validation(tuning.table), seed=TUNING, looks=LOOKS)
    models = [with_settings(best, split, n_samples) for split in splits]
    settings = f"{best.settings}, {best.passes} passes"
    yield {"table": "mixed", "model": "RBM", **row_of(models, splits, base), "settings": settings}
    tempered = best._replace(settings=replace(best.settings, sampler=ParallelTempering))
    models = [with_settings(tempered, split, n_samples) for split in splits]
    yield {"table": "mixed", "model": TEMPERED, **row_of(models, splits, base), "settings": "the same"}
    for name, method in {"the true density": truth, "training rows": training_rows}.items():
        models = [method(split, n_samples) for split in splits]
        yield {"table": "mixed", "model": name, **row_of(models, splits, base)}


def of_scikit_learn(name: str, plan: Plan) -> Iterator[dict[str, Any]]:
    """Rows of a table of scikit-learn; settings are chosen on the validation rows of each split."""
    n_samples, splits = plan.n_samples, [shipped_table(name, seed) for seed in plan.seeds]
    base = [independent(split, n_samples) for split in splits]
    methods: dict[str, Method] = {
        "independent columns": independent,
        "GaussianMixture": partial(gaussian_mixture, plan.components),
        "RBM at the defaults of 0.2": partial(as_typed, plan.typed),
        "RBM": partial(chosen_here, plan.of_shipped),
        "training rows": training_rows,
    }
    for model, method in methods.items():
        models = [method(split, n_samples) for split in splits]
        settings = "; ".join(one.settings for one in models if one.settings)
        yield {"table": name, "model": model, **row_of(models, splits, base), "settings": settings}


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each table and model."""
    plan = Plan()
    if quick:
        small = Settings(n_hidden=2, rate=0.4, passes=LOOKS)
        plan = Plan(
            seeds=SEEDS[:2],
            sizes=Sizes(300, 50, 200),
            n_samples=200,
            typed=small,
            of_mixed=[small],
            shipped=["wine"],
            of_shipped=[small],
            components=(1, 2),
        )
    yield from made(plan)
    for name in plan.shipped:
        yield from of_scikit_learn(name, plan)
