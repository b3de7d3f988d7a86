"""What a comparison of density models is made of: ``conf/density``, which explains each line."""

from dataclasses import dataclass

from memcomp_lightning.errors import require, require_choice, require_count, require_some
from memcomp_lightning.studies.search import Axes, Setting, checked_start


@dataclass(frozen=True, kw_only=True)
class Model:
    """An energy model with its negative phase.

    Attributes:
        label: For people.
        overrides: Of its runs, as on the command line; ``{NAME}`` stands for the value of a setting.
        axes: Settings that are searched in place of those of all models, and the values of each in rising order.
        start: Where the search starts, in place of those of all models.
        compared: Whether it takes part in the question which negative phase is worth its time.
    """

    label: str
    overrides: list[str]
    axes: Axes | None = None
    start: Setting | None = None
    compared: bool = True


@dataclass(frozen=True, kw_only=True)
class Density:
    """The settings of ``conf/density``. Numbers are >= 1."""

    name: str
    title: str
    folder: str | None
    tables: list[str]
    only: list[str] | None
    replicas: int
    peer_replicas: int
    points: int
    patience: int
    quick_betas: int
    betas: int
    chains: int
    overrides: list[str]
    axes: Axes
    start: Setting
    models: dict[str, Model]
    baselines: list[str]
    peers: str | None
    peers_python: str | None
    workers: int | str | None

    def __post_init__(self) -> None:
        for name in ("replicas", "peer_replicas", "points", "patience", "quick_betas", "betas"):
            require_count(f"density.{name}", getattr(self, name))
        require_count("density.chains", self.chains, minimum=2)
        require_some("density.tables", self.tables, "names of tables")
        require_some("density.only", self.only, "names of models and peers, or null for all")
        for name in self.baselines:
            require_choice("density.baselines", name, tuple(self.models))
        for name in self.models:
            at = f"density.models.{name}.start"
            require("updates" in self.start_of(name), at, self.models[name].start, "one with updates, a number")

    def axes_of(self, model: str) -> Axes:
        """What is searched for a model."""
        own = self.models[model].axes
        return self.axes if own is None else own

    def start_of(self, model: str) -> Setting:
        """Where its search starts: settings that are no axis of it keep their value."""
        start = {**self.start, **(self.models[model].start or {})}
        return checked_start(self.axes_of(model), start, f"density.models.{model}")

    def takes(self, method: str) -> bool:
        """Whether a model or a peer is part of this run."""
        return self.only is None or method in self.only
