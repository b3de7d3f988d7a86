"""The restricted Boltzmann machine as a transformer."""

import math
import warnings
from dataclasses import KW_ONLY, dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import train_test_split
from sklearn.utils.validation import check_is_fitted

from memcomp_lightning import rng
from memcomp_lightning.ambient import on_the_cpu
from memcomp_lightning.data import Batches
from memcomp_lightning.defaults import (
    TABLE_BATCH_SIZE,
    TABLE_HIDDEN,
    TABLE_LADDERS,
    TABLE_LAST_RATE,
    TABLE_LEARNING_RATE,
    TABLE_MOST_PASSES,
    TABLE_TEMPERATURES,
    TABLE_UPDATES,
    WEIGHT_STD,
)
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.estimators.base import (
    MemcompEstimator,
    RandomState,
    array_of,
    dbn_for,
    in_precision_of,
    seed_of,
)
from memcomp_lightning.estimators.inputs import (
    Array,
    Matrix,
    Samples,
    batches_of,
    dense_parts,
    hidden_means,
    log_odds_of,
)
from memcomp_lightning.likelihood import (
    Ais,
    exact_samples,
    log_likelihood,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.likelihood.chains import MOST_BEHIND, gap_of_chains, stopped_mixing
from memcomp_lightning.models.chains import sweep
from memcomp_lightning.samplers import ParallelTempering
from memcomp_lightning.training import Greedy, LearningRateDecay, PhaseTraining, require_finite

MOST_WEIGHTS = 2**18
"""Weights up to which ``fit`` looks whether its chains are behind."""

MOST_ENUMERATED = 20
"""Units of the smaller layer up to which a log-likelihood is exact."""


@dataclass(eq=False, repr=False)
class MemcompRBM(ClassNamePrefixFeaturesOutMixin, TransformerMixin, MemcompEstimator):  # type: ignore[misc]
    """Bernoulli RBM whose negative phase is any sampler of this package.

    Values in [0, 1] stand for probabilities. A column that is within [0, 1] in ``fit`` is left as it is. One that
    is not is scaled to [0, 1] by its range; if it is constant, it becomes 0 (below 0) or 1 (above 1). Later values
    beyond are clipped. Dense and sparse (CSR) inputs give the same; of a sparse one no more than a mini-batch is
    made dense. Training and results are in the precision of the input, float32 or float64.

    The visible biases start at the log odds of the data's means (Hinton 2010, section 8).

    Args:
        n_components: Hidden units, >= 1.
        sampler: Supplies the negative phase; None is ``ParallelTempering(n_chains=20, n_temperatures=5)``. Its
            settings are ``sampler__k`` and so on, for ``set_params`` and searches.
        learning_rate: Of plain gradient descent, > 0.
        last_rate: Share of the learning rate in the last pass of ``fit``, to which it falls linearly, in (0, 1].
            At a rate that stays chains lag behind the model and may stop mixing.
        batch_size: Samples an update, >= 1; None means all.
        n_iter: Passes over the data, >= 1; with ``early_stopping`` at most so many. None makes up 10,000 updates,
            in ten passes at least; without ``early_stopping`` in 200 at most: more would learn few rows by heart.
        centred: Follow the centred gradient.
        early_stopping: Hold out samples, stop once their :meth:`score` no longer rises, and keep the weights of
            the best pass.
        validation_fraction: Share held out, in (0, 1).
        n_iter_no_change: Passes without a better score, >= 1, after which training stops.
        tol: By how much a score must be better to count, in nats, >= 0.
        verbose: Print a line a pass.
        random_state: Seed, generator or None, as everywhere in scikit-learn; NumPy's ``Generator`` too.

    Attributes:
        rbm_: The trained :class:`memcomp_lightning.models.RBM`.
        n_iter_: Passes done.
        validation_scores_: Score of the held-out samples after each pass; None without ``early_stopping``.

    >>> import numpy as np
    >>> MemcompRBM(n_components=2, n_iter=3, random_state=0).fit_transform(np.eye(4)).shape
    (4, 2)
    """

    n_components: int = TABLE_HIDDEN
    _: KW_ONLY
    learning_rate: float = TABLE_LEARNING_RATE
    last_rate: float = TABLE_LAST_RATE
    batch_size: int | None = TABLE_BATCH_SIZE
    n_iter: int | None = None

    def _default_sampler(self) -> ParallelTempering:
        return ParallelTempering(n_chains=TABLE_LADDERS, n_temperatures=TABLE_TEMPERATURES)

    def fit(self, X: ArrayLike, y: object = None, sample_weight: ArrayLike | None = None) -> Self:
        """Train from new weights.

        Args:
            X: ``(n_samples, n_features)``, dense or sparse.
            y: Not used.
            sample_weight: How often each sample counts, >= 0, ``(n_samples,)``; None means once.

        Raises:
            SettingError: A setting is out of range.
            DivergedError: A parameter left the finite numbers.
        """
        self._check_settings()
        samples = self._read_samples(X, sample_weight, reset=True)
        seed = seed_of(self.random_state)
        samples, held_out = self._scaled(samples, begins=True), None
        if self.early_stopping:
            rows, others = train_test_split(
                np.arange(samples.X.shape[0]), test_size=self.validation_fraction, random_state=seed
            )
            samples, held_out = samples.take(rows), samples.take(others)
        with on_the_cpu():
            self._begin(samples, seed, n_passes=self._n_passes(samples))
            self._run_passes(self.rbm_, samples, held_out)
            if not self.early_stopping:  # which ends with weights that the last chains do not belong to
                self._warn_if_chains_are_behind()
        return self

    def partial_fit(self, X: ArrayLike, y: object = None, sample_weight: ArrayLike | None = None) -> Self:
        """Do one pass over these samples; chains, centres and optimiser go on from the last call, or from ``fit``.

        The first call draws the weights and settles scaling and first biases by its samples. Arguments and errors
        are those of :meth:`fit`.
        """
        self._check_settings()
        self._refuse_early_stopping()
        begins = not hasattr(self, "rbm_")
        samples = self._scaled(self._read_samples(X, sample_weight, reset=begins), begins=begins)
        with on_the_cpu():
            if begins:
                self._begin(samples, seed_of(self.random_state))
            self._training.go_on_with(self._negative_phase(), self._centring())
            self._go_on(self.rbm_, samples)
        return self

    def _check_settings(self) -> None:
        require_count("n_components", self.n_components)
        require(0 < self.last_rate <= 1, "last_rate", self.last_rate, "a share in (0, 1]")
        super()._check_settings()

    def _read_samples(self, X: ArrayLike, sample_weight: ArrayLike | None, *, reset: bool) -> Samples:
        data = self._read(X, reset=reset)
        return Samples.that_count(data, np.zeros(data.shape[0], dtype=np.int64), sample_weight)

    def _n_passes(self, samples: Samples) -> int:
        if self.n_iter is not None:
            return int(self.n_iter)
        n: int = samples.X.shape[0]
        passes = max(10, round(TABLE_UPDATES / math.ceil(n / min(self.batch_size or n, n))))
        return passes if self.early_stopping else min(passes, TABLE_MOST_PASSES)

    def _begin(self, samples: Samples, seed: int, n_passes: int | None = None) -> None:
        """Draw weights; the rate falls over ``n_passes``, and stays where None is given."""
        dbn = dbn_for(samples.X, [int(self.n_components)], std=WEIGHT_STD, generator=rng.stream(seed, "weights"))
        rbm = dbn[0]
        self._base = log_odds_of(samples).to(rbm.b)
        rbm.b.data.copy_(self._base)
        self.rbm_, self.n_iter_, self._seed = rbm, 0, seed
        self._training = PhaseTraining(
            Greedy(dbn).phases[0],
            self._negative_phase(),
            optimizer=self._optimizer(),
            schedules=[LearningRateDecay(n_passes, self.last_rate)] if n_passes and self.last_rate < 1 else [],
            centring=self._centring(),
            streams=rng.streams(seed, ("negative_phase", "positive_phase")),
        )
        self._gibbs_generator = rng.stream(seed, "gibbs")

    def _warn_if_chains_are_behind(self) -> None:
        """Say so where persistent chains are no samples of the model, if that takes less than about a second."""
        chains, rbm = self._training.chains(rng.stream(self._seed, "check")), self.rbm_
        if chains is None or rbm.n_visible * rbm.n_hidden > MOST_WEIGHTS:
            return
        gap = float(gap_of_chains(rbm, chains, base=self._base))
        if gap > MOST_BEHIND:
            warnings.warn(
                f"At the end of fit {stopped_mixing(gap)}, and the model may be worse than earlier. Lower "
                "learning_rate or last_rate, or take more chains or several temperatures: "
                "sampler=memcomp_lightning.samplers.ParallelTempering().",
                ConvergenceWarning,
                stacklevel=3,
            )

    def _batches(self, samples: Samples) -> Batches:
        sampler = self._negative_phase()
        return batches_of(samples, batch_size=self.batch_size, sampler=sampler, seed=self._seed)

    def _run_pass(self, batches: Batches) -> None:
        super()._run_pass(batches)
        require_finite(self.rbm_, "pretraining")

    def _score_held_out(self, samples: Samples) -> float:
        return float(np.average(self._pseudo_likelihood(samples.X), weights=samples.weight))

    @property
    def components_(self) -> Array:
        """Weights, ``(n_components, n_features)``."""
        return self.rbm_.weight.detach().numpy()

    @property
    def intercept_hidden_(self) -> Array:
        """Hidden biases, ``(n_components,)``."""
        return self.rbm_.c.detach().numpy()

    @property
    def intercept_visible_(self) -> Array:
        """Visible biases, ``(n_features,)``."""
        return self.rbm_.b.detach().numpy()

    @property
    def _n_features_out(self) -> int:
        return self.rbm_.n_hidden

    def transform(self, X: ArrayLike) -> Array:
        """Hidden means given the data, ``(n_samples, n_components)``, in the precision of X."""
        X = self._checked(X)
        with on_the_cpu(), torch.no_grad():
            data, rbm = in_precision_of(X, self.rbm_)
            return array_of(hidden_means(rbm, data), like=X)

    def gibbs(self, v: ArrayLike) -> Array:
        """One step of Gibbs sampling from each sample: hidden units given it, visible units given them.

        Every call draws on from the random stream that ``fit`` began.

        Returns:
            Visible units, ``(n_samples, n_features)``, in the precision and in the units of the data: 0 and 1, or
            the ends of the range of a column that is scaled.
        """
        X = self._checked(v)
        with on_the_cpu(), torch.no_grad():
            data, rbm = in_precision_of(X, self.rbm_)
            parts = [sweep(rbm, part, generator=self._gibbs_generator) for part in dense_parts(data)]
            return self._scaling.to_data(array_of(torch.cat(parts), like=X))

    def sample(self, n_samples: int = 1, *, n_steps: int = 1000, random_state: RandomState = None) -> Array:
        """Draw samples from the model.

        They are exact and independent with up to 20 hidden units or features. Otherwise each is the end of a Gibbs
        chain that starts at independent features with the means of the data.

        Args:
            n_samples: How many, >= 1.
            n_steps: Gibbs steps of a chain, >= 1.
            random_state: Of the draws; None goes on with the stream that ``fit`` began.

        Returns:
            ``(n_samples, n_features)``, as of :meth:`gibbs`.
        """
        check_is_fitted(self)
        require_count("n_samples", n_samples)
        require_count("n_steps", n_steps)
        generator = self._gibbs_generator
        if random_state is not None:
            generator = rng.stream(seed_of(random_state), "gibbs")
        with on_the_cpu(), torch.no_grad():
            if self._is_small():
                v = exact_samples(self.rbm_, n_samples, generator=generator)
            else:
                v = rng.bernoulli(torch.sigmoid(self._base).expand(n_samples, -1), generator=generator)
                for _ in range(n_steps):
                    v = sweep(self.rbm_, v, generator=generator)
            return self._scaling.to_data(v.numpy())

    def score_samples(self, X: ArrayLike) -> NDArray[np.float64]:
        """Log pseudo-likelihood of each sample in nats, features rounded to 0 or 1, ``(n_samples,)`` float64."""
        X = self._checked(X)
        with on_the_cpu():
            return self._pseudo_likelihood(X)

    def _pseudo_likelihood(self, X: Matrix) -> NDArray[np.float64]:
        parts = [log_pseudo_likelihood(self.rbm_, part.round()).sum(-1) for part in dense_parts(X)]
        return torch.cat(parts).detach().numpy()

    def score(self, X: ArrayLike, y: object = None) -> float:
        """Mean of :meth:`score_samples`: what a grid search maximises."""
        return float(self.score_samples(X).mean())

    def log_likelihood(self, X: ArrayLike) -> NDArray[np.float64]:
        """Log-likelihood of each sample in nats, features rounded to 0 or 1, ``(n_samples,)`` float64.

        Exact with up to 20 hidden units or features, otherwise by annealed importance sampling.
        """
        X = self._checked(X)
        with on_the_cpu():
            if self._is_small():
                log_z = log_partition_function(self.rbm_)
            else:
                log_z = Ais().estimate(self.rbm_, generator=rng.stream(0, "ais"), base=self._base).log_z
            parts = [log_likelihood(self.rbm_, part.round(), log_z) for part in dense_parts(X)]
            return torch.cat(parts).detach().numpy()

    def _is_small(self) -> bool:
        return min(self.rbm_.n_visible, self.rbm_.n_hidden) <= MOST_ENUMERATED
