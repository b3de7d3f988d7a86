"""Genotypes with gaps: cells filled and unusual individuals found, beside the methods that are used for it.

The distribution is known, so that what the best of all models could do stands in the table, too.
"""

import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from fitting import AS_TYPED, Settings, choose, read, trained
from haplotypes import N_VALUES, Genotypes, Matrix, Panel
from medians import shown
from numpy.typing import NDArray
from sklearn.ensemble import IsolationForest
from sklearn.experimental import enable_iterative_imputer  # noqa: F401
from sklearn.impute import IterativeImputer, KNNImputer, SimpleImputer
from sklearn.metrics import roc_auc_score
from sklearn.neighbors import NearestNeighbors

from memcomp_lightning import rng
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.tables import TableData
from memcomp_lightning.trained.imputation import impute
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.values import complete_values


class Forest(NamedTuple):
    """Settings of an IsolationForest.

    Attributes:
        n_trees: Number of trees.
        n_rows: Training rows of each tree, at most.
        share: Of the columns, of each tree.
    """

    n_trees: int
    n_rows: int
    share: float


GAPS = 0.05
"""Share of the cells that are missing."""
SEEDS, TUNING = (0, 1, 2, 3, 4, 5), 100
NEIGHBOURS = (3, 5, 10, 20, 50)
PREDICTORS = (10, 30, None)
"""Columns of which IterativeImputer predicts each one; None is all."""
FORESTS = [
    Forest(n_trees, n_rows, share) for n_trees in (100, 500) for n_rows in (256, 1500) for share in (0.2, 1.0)
]
GRID = [
    Settings(n_hidden=n_hidden, rate=rate, l1=l1, passes=40)
    for n_hidden, rate, l1 in (
        *(
            (200, 0.2, 0.0),
            (200, 0.2, 0.001),
            (200, 0.4, 0.001),
            (200, 0.4, 0.002),
            (200, 0.4, 0.004),
            (200, 0.8, 0.002),
        ),
        *((100, 0.4, 0.002), (100, 0.8, 0.004)),
    )
]


class Sizes(NamedTuple):
    """Rows of each part; as many anomalies of each kind as test rows."""

    train: int = 1500
    validation: int = 500
    test: int = 500


class Cells(NamedTuple):
    """Genotypes, and which of them are known."""

    true: Genotypes
    observed: NDArray[np.bool_]

    @property
    def gapped(self) -> Matrix:
        """With NaN in the gaps."""
        return np.where(self.observed, self.true, np.nan)


class Data(NamedTuple):
    """A table of one seed.

    Attributes:
        panel: What made it: three populations.
        train, validation, test: Cells.
        anomalies: Rows without gaps, by kind.
        table: The same as memcomp_lightning reads it.
    """

    panel: Panel
    train: Cells
    validation: Cells
    test: Cells
    anomalies: dict[str, Genotypes]
    table: TableData

    @classmethod
    def draw(cls, seed: int, sizes: Sizes, **shape: int) -> "Data":
        """Individuals of three populations, and anomalies: those of a fourth one, and rows of shuffled columns."""
        generator = rng.numpy_stream(seed, f"genotypes {GAPS}")
        panel = Panel.draw(generator, **shape)
        known, other = panel.of(slice(3)), panel.of(slice(3, 4))
        parts = {}
        for name, n in sizes._asdict().items():
            rows = known.sample(n, generator)
            parts[name] = Cells(rows, generator.random(rows.shape) >= GAPS)
        columns = known.sample(sizes.test, generator).T
        anomalies = {
            "foreign": other.sample(sizes.test, generator),
            "shuffled": np.stack([generator.permutation(column) for column in columns], axis=1),
        }
        with tempfile.TemporaryDirectory() as folder:
            table = read(Path(folder), **{name: part.gapped for name, part in parts.items()})
        return cls(known, **parts, anomalies=anomalies, table=table)


class Filled(NamedTuple):
    """What stands in the gaps.

    Attributes:
        value: Filled in, ``(n_gaps,)``.
        probability: Of the true value; None of methods that give no probabilities.
    """

    value: Matrix
    probability: Matrix | None = None


def of_probabilities(probability: Matrix, cells: Cells) -> Filled:
    """The likeliest value of each gap, of probabilities of all cells ``(n, n_sites, 3)``."""
    at, true = ~cells.observed, cells.true
    of_true = np.take_along_axis(probability, true[..., None], axis=-1)[..., 0]
    return Filled(probability.argmax(-1)[at], of_true[at])


def by_run(run: Run, rows: Rows, cells: Cells) -> Filled:
    """Of an RBM, by its conditional probabilities."""
    probability = np.zeros((*cells.true.shape, N_VALUES))
    for gaps in impute(run, rows).gaps:
        assert gaps.probability is not None
        probability[gaps.row.numpy(), gaps.site] = gaps.probability.double().numpy()
    return of_probabilities(probability, cells)


def by_mode(data: Data, cells: Cells) -> Filled:
    """The most frequent value of the column, with its frequency."""
    found = SimpleImputer(strategy="most_frequent").fit(data.train.gapped).transform(cells.gapped)
    counts = np.stack([(data.train.gapped == value).sum(0) + 1.0 for value in range(N_VALUES)], axis=-1)
    share = np.broadcast_to(counts / counts.sum(-1, keepdims=True), (*cells.true.shape, N_VALUES))
    return of_probabilities(share, cells)._replace(value=found[~cells.observed])


def rounded(imputer: Any, data: Data, cells: Cells) -> Filled:
    """The nearest genotype of what an imputer of numbers fills in."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the iterations of IterativeImputer are limited
        found = imputer.fit(data.train.gapped).transform(cells.gapped)
    return Filled(found.round().clip(0, N_VALUES - 1)[~cells.observed])


def nearest(k: int) -> KNNImputer:
    return KNNImputer(n_neighbors=k, weights="distance")


def iterative(n_predictors: int | None, seed: int) -> IterativeImputer:
    return IterativeImputer(max_iter=5, n_nearest_features=n_predictors, random_state=seed)


def correct(filled: Filled, cells: Cells) -> float:
    """Share of the gaps with the right value."""
    return float((filled.value == cells.true[~cells.observed]).mean())


def log_loss(filled: Filled) -> float:
    """Mean of -log of the probability of the true value."""
    if filled.probability is None:
        return np.nan
    return float(-np.log(filled.probability.clip(1e-12)).mean())


def auc(data: Data, surprise: Callable[[Genotypes], Matrix]) -> dict[str, float]:
    """Area under the ROC curve: how often an anomaly is more of a surprise than a test row, by kind."""
    usual, found = surprise(data.test.true), {}
    for kind, rows in data.anomalies.items():
        label = np.repeat([0, 1], [len(usual), len(rows)])
        found[kind] = float(roc_auc_score(label, np.concatenate((usual, surprise(rows)))))
    return found


def free_energy(run: Run) -> Callable[[Genotypes], Matrix]:
    """Minus the log-likelihood but for a constant, log Z."""

    def surprise(rows: Genotypes) -> Matrix:
        given = Rows(torch.tensor(rows, dtype=torch.float32), torch.full((len(rows),), -1))
        with torch.no_grad():
            return run.model.free_energy(complete_values(run, given)).double().numpy()

    return surprise


def neighbour_distance(data: Data, k: int) -> Callable[[Genotypes], Matrix]:
    """Mean distance of the k nearest training rows, over the columns that are known of these."""
    near = NearestNeighbors(n_neighbors=k, metric="nan_euclidean").fit(data.train.gapped)
    return lambda rows: np.asarray(near.kneighbors(rows.astype(float))[0].mean(1))


def isolation(data: Data, settings: Forest, seed: int) -> Callable[[Genotypes], Matrix]:
    """Of a forest, which knows gaps."""
    n_rows = min(settings.n_rows, len(data.train.true))
    forest = IsolationForest(
        n_estimators=settings.n_trees, max_samples=n_rows, max_features=settings.share, random_state=seed
    ).fit(data.train.gapped)
    return lambda rows: np.asarray(-forest.score_samples(rows.astype(float)))


def by_columns(data: Data) -> Callable[[Genotypes], Matrix]:
    """Minus the log-likelihood of independent columns."""
    counts = np.stack([(data.train.gapped == value).sum(0) + 1.0 for value in range(N_VALUES)], axis=-1)
    surprise = -np.log(counts / counts.sum(-1, keepdims=True))
    return lambda rows: surprise[np.arange(rows.shape[1]), rows].sum(-1)


class Tuned(NamedTuple):
    """What is chosen on a table that is not measured.

    Attributes:
        settings: Of the RBM.
        k_fill: Neighbours that fill gaps, by the share that is right in validation rows.
        n_predictors: Columns of which IterativeImputer predicts each one, by the same.
        k_near: Neighbours that tell anomalies, by the anomalies of that table.
        forest: Of an IsolationForest, by the same.
    """

    settings: Settings
    k_fill: int
    n_predictors: int | None
    k_near: int
    forest: Forest

    @classmethod
    def on(cls, data: Data, settings: Settings, neighbours: Sequence[int]) -> "Tuned":
        cells = data.validation

        def filled(imputer: Any) -> float:
            return correct(rounded(imputer, data, cells), cells)

        def area(surprise: Callable[[Genotypes], Matrix]) -> float:
            return sum(auc(data, surprise).values())

        return cls(
            settings,
            max(neighbours, key=lambda k: filled(nearest(k))),
            max(PREDICTORS, key=lambda n: filled(iterative(n, TUNING))),
            max(neighbours, key=lambda k: area(neighbour_distance(data, k))),
            max(FORESTS, key=lambda forest: area(isolation(data, forest, TUNING))),
        )

    @property
    def notes(self) -> dict[str, str]:
        """What was chosen, by method."""
        columns = "all" if self.n_predictors is None else self.n_predictors
        forest = (
            f"{self.forest.n_trees} trees of {self.forest.n_rows} rows, {self.forest.share:.0%} of the columns"
        )
        return {
            "nearest neighbours": f"k = {self.k_fill} to fill, {self.k_near} to tell",
            "IterativeImputer": f"of {columns} columns",
            "IsolationForest": forest,
            "RBM at the defaults of 0.2": f"{AS_TYPED}, {AS_TYPED.passes} passes",
            "RBM": f"{self.settings}, {self.settings.passes} passes",
        }


def chosen(data: Data, grid: Sequence[Settings]) -> Settings:
    """Settings of the RBM with the least log loss of gaps in validation rows."""

    def quality(run: Run) -> float:
        return -log_loss(by_run(run, data.table.validation, data.validation))

    return choose(data.table, grid, quality, seed=TUNING).settings


class Found(NamedTuple):
    """What a method makes of one table.

    Attributes:
        filled: What stands in the gaps of the test rows; None of methods that fill none.
        areas: Under the ROC curve, by kind of anomalies; None of methods that tell none.
    """

    filled: Filled | None
    areas: dict[str, float] | None = None

    def numbers(self, data: Data) -> dict[str, float]:
        """Columns of the table."""
        found = dict[str, float]()
        if self.filled is not None:
            found |= {"correct": correct(self.filled, data.test), "log loss": log_loss(self.filled)}
        return found | {f"AUC, {kind}": area for kind, area in (self.areas or {}).items()}


def columns_alone(data: Data, tuned: Tuned, seed: int) -> Found:
    return Found(by_mode(data, data.test), auc(data, by_columns(data)))


def nearest_rows(data: Data, tuned: Tuned, seed: int) -> Found:
    areas = auc(data, neighbour_distance(data, tuned.k_near))
    return Found(rounded(nearest(tuned.k_fill), data, data.test), areas)


def iterations(data: Data, tuned: Tuned, seed: int) -> Found:
    return Found(rounded(iterative(tuned.n_predictors, seed), data, data.test))


def trees(data: Data, tuned: Tuned, seed: int) -> Found:
    return Found(None, auc(data, isolation(data, tuned.forest, seed)))


def rbm(data: Data, tuned: Tuned, seed: int) -> Found:
    return of_settings(tuned.settings, data, seed)


def untuned_rbm(data: Data, tuned: Tuned, seed: int) -> Found:
    return of_settings(AS_TYPED, data, seed)


def of_settings(settings: Settings, data: Data, seed: int) -> Found:
    """An RBM of the training rows."""
    *_, (_, run) = trained(data.table, settings, seed=seed)
    return Found(by_run(run, data.table.test, data.test), auc(data, free_energy(run)))


def truth(data: Data, tuned: Tuned, seed: int) -> Found:
    exact = data.panel.exact(*data.test).probability
    areas = auc(data, lambda rows: -data.panel.exact(rows, np.ones_like(rows, dtype=bool)).log_likelihood)
    return Found(of_probabilities(exact, data.test), areas)


METHODS: dict[str, Callable[[Data, Tuned, int], Found]] = {
    "independent columns, modes": columns_alone,
    "nearest neighbours": nearest_rows,
    "IterativeImputer": iterations,
    "IsolationForest": trees,
    "RBM at the defaults of 0.2": untuned_rbm,
    "RBM": rbm,
    "the true distribution": truth,
}


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each method."""
    sizes, seeds, grid, neighbours, shape = Sizes(), SEEDS, GRID, NEIGHBOURS, dict[str, int]()
    if quick:
        sizes, seeds, shape = Sizes(80, 40, 200), SEEDS[:2], {"n_blocks": 2, "n_sites_of_block": 4}
        grid, neighbours = [Settings(n_hidden=8, rate=rate, l1=0.001, passes=2) for rate in (0.2, 0.4)], (5, 10)
    tuning = Data.draw(TUNING, sizes, **shape)
    tuned = Tuned.on(tuning, chosen(tuning, grid), neighbours)
    tables = [Data.draw(seed, sizes, **shape) for seed in seeds]
    for name, method in METHODS.items():
        found = [method(data, tuned, seed).numbers(data) for data, seed in zip(tables, seeds, strict=True)]
        medians = {what: shown([numbers[what] for numbers in found]) for what in found[0]}
        yield {"method": name, **medians, "settings": tuned.notes.get(name, "")}
