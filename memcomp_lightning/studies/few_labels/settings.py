"""What a study of few labels is made of: ``conf/few_labels``, which explains each line."""

from dataclasses import dataclass
from typing import Any

from memcomp_lightning.errors import require, require_choice, require_count, require_some
from memcomp_lightning.studies.few_labels.learner import Lengths
from memcomp_lightning.studies.search import Axes, Setting, checked_start

BEST = "{best}"
"""Stands for the pretraining that cross-validation likes best, in the names of a claim."""


@dataclass(frozen=True, kw_only=True)
class Pretraining:
    """A way of pretraining without labels.

    Attributes:
        overrides: Of its run, as on the command line.
        way: What trains the DBN in the place of that run, with a ``_target_``; None is nothing else.
    """

    overrides: list[str]
    way: dict[str, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class Search:
    """What cross-validation tunes: the values of each axis in rising order, and where the search starts."""

    axes: Axes
    start: Setting

    def __post_init__(self) -> None:
        checked_start(self.axes, self.start, "few_labels.searches")


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way to learn from few labels.

    Attributes:
        label: For people.
        panel: Of the figure.
        search: Name of what is tuned.
        learner: With a ``_target_``, a :class:`memcomp_lightning.studies.few_labels.learner.Learner`.
        pretraining: Name of the pretraining that it needs; None needs none.
        after: Method that it goes on from, whose setting it takes; None is no other.
    """

    label: str
    panel: str
    search: str
    learner: dict[str, Any]
    pretraining: str | None = None
    after: str | None = None


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One method is better than another; ``{best}`` in a name stands for the best pretraining.

    Attributes:
        better, than: Names of methods.
        controls: Of methods that may explain the gain.
    """

    better: str
    than: str
    controls: list[str]


@dataclass(frozen=True, kw_only=True)
class FewLabels:
    """The settings of ``conf/few_labels``. Numbers are >= 1."""

    name: str
    title: str
    labels: list[int | None]
    draws: int
    draws_of_all: int
    pretrainings: int
    only: list[str] | None
    folds: int
    folds_of_many: int
    many: int
    updates: int
    passes: int
    measured: int
    batch_sizes: list[int]
    overrides: list[str]
    pretraining: dict[str, Pretraining]
    searches: dict[str, Search]
    methods: dict[str, Method]
    claims: list[Claim]
    candidates: list[str]
    worth: list[str]
    workers: int | str | None

    def __post_init__(self) -> None:
        for name in ("draws", "draws_of_all", "pretrainings", "many", "updates", "passes", "measured"):
            require_count(f"few_labels.{name}", getattr(self, name))
        for name in ("folds", "folds_of_many"):
            require_count(f"few_labels.{name}", getattr(self, name), minimum=2)
        require_some("few_labels.labels", self.labels, "numbers of labels, null for all")
        for n in self.labels:
            if n is not None:
                require_count("few_labels.labels", n)
        require_some("few_labels.only", self.only, "names of methods, or null for all")
        sizes = self.batch_sizes
        fits = len(sizes) == 2 and 1 <= sizes[0] <= sizes[1]
        require(fits, "few_labels.batch_sizes", sizes, "the fewest and the most rows of an update")
        for name in self.only or ():
            require_choice("few_labels.only", name, tuple(self.methods))
        for name in self.candidates:
            require_choice("few_labels.candidates", name, tuple(self.methods))
        for claim in self.claims:
            for name in (claim.better, claim.than, *claim.controls):
                self._check_named("few_labels.claims", name)
        for name in self.worth:
            self._check_named("few_labels.worth", name)
        for name, method in self.methods.items():
            at = f"few_labels.methods.{name}"
            require_choice(f"{at}.search", method.search, tuple(self.searches))
            if method.pretraining is not None:
                require_choice(f"{at}.pretraining", method.pretraining, tuple(self.pretraining))
            if method.after is not None:
                require_choice(f"{at}.after", method.after, tuple(self.methods))
                missing = self.takes(name) and not self.takes(method.after)
                remedy = f"It goes on from {method.after}: name both."
                require(not missing, "few_labels.only", self.only, f"a list with {method.after}", remedy)

    def _check_named(self, at: str, name: str) -> None:
        """A name in a claim must be that of a method, with each candidate in the place of the best one."""
        for candidate in self.candidates:
            require_choice(at, name.replace(BEST, candidate), tuple(self.methods))

    @property
    def lengths(self) -> Lengths:
        """Of training."""
        return Lengths(
            updates=self.updates, passes=self.passes, measured=self.measured, batch_sizes=self.batch_sizes
        )

    def takes(self, method: str) -> bool:
        """Whether a method is part of this run."""
        return self.only is None or method in self.only

    @property
    def taken(self) -> dict[str, Method]:
        """The methods of this run."""
        return {name: method for name, method in self.methods.items() if self.takes(name)}

    @property
    def needed(self) -> dict[str, Pretraining]:
        """The pretrainings of this run."""
        used = {method.pretraining for method in self.taken.values()}
        return {name: own for name, own in self.pretraining.items() if name in used}

    def n_draws(self, n: int | None) -> int:
        """Draws of so many labels; of all there is one, and seeds alone differ."""
        return self.draws if n is not None else min(self.draws, self.draws_of_all)

    def n_folds(self, n: int) -> int:
        """Of the cross-validation."""
        return self.folds if n <= self.many else self.folds_of_many
