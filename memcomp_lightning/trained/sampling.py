"""Rows drawn from a trained model, by chains whose mixing is measured and said."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.errors import UserError, require, require_choice, require_count
from memcomp_lightning.likelihood.layers import require_finite
from memcomp_lightning.models import DBN, RBM, EnergyModel
from memcomp_lightning.models.conditioned import conditioned, tempered
from memcomp_lightning.models.units import Units
from memcomp_lightning.trained.chains.drawing import METHODS, Effort, draw
from memcomp_lightning.trained.chains.report import Mixing
from memcomp_lightning.trained.chains.target import Target
from memcomp_lightning.trained.given import given_row
from memcomp_lightning.trained.run import Run


class Samples(NamedTuple):
    """Rows that were drawn.

    Attributes:
        v: A number a site, as the data are kept, ``(n, n_sites)``: ``run.schema.decode`` gives the user's columns.
        mixing: How they were drawn, and how far they can be trusted.
    """

    v: Tensor
    mixing: Mixing


@torch.no_grad()
def sample(
    model: Run | EnergyModel | DBN,
    n: int,
    *,
    given: Rows | Mapping[str, Any] | None = None,
    temperature: float = 1.0,
    method: str = "auto",
    seed: int = 0,
    n_chains: int = 128,
    most_sweeps: int = 4096,
) -> Samples:
    r"""Draw rows from a trained model.

    ``auto`` draws independent rows where a layer of up to 16 bits can be enumerated; else it runs Gibbs chains
    from starts that are far apart, and if R-hat says that they do not mix, parallel tempering, whose own mixing
    is measured in the same way. What is watched: the free energy, and principal components of the visible units.

    A deep belief network whose layers were trained one after the other gives samples of its top layer, drawn layer
    by layer down to the data (Hinton, Osindero & Teh 2006).

    Args:
        model: A trained run, an energy model without replica axes, or a DBN.
        n: Rows, >= 1; with ``given``, of each of its rows.
        given: Known values of columns, in the user's words, for all rows; or rows with gaps, each of which is
            completed n times.
        temperature: > 0. Its inverse beta multiplies couplings and biases: below 1 the likely becomes more likely.
            It leaves the measures of the units: the spread of a real unit given its field stays. Of a deep belief
            network it is that of the top layer.
        method: ``auto``, ``exact``, ``gibbs`` or ``tempering``.
        seed: Of all draws.
        n_chains: Chains side by side, >= 32.
        most_sweeps: Sweeps by which chains are judged at most, >= 256; there are as many before them.

    Raises:
        UserError, SettingError: A column or a word is not known; a value is out of range; the model is too large
            for ``exact``.
    """
    require_count("n", n)
    require(_is_positive(temperature), "temperature", temperature, "a finite number > 0")
    require_choice("method", method, METHODS)
    require_count("n_chains", n_chains, 32)
    require_count("most_sweeps", most_sweeps, 256)
    run = model if isinstance(model, Run) else None
    network: Any = model.network if isinstance(model, Run) else model
    settings: dict[str, Any] = {
        "method": method,
        "effort": Effort(n_chains, most_sweeps),
        "generator": rng.stream(seed, "sampling"),
    }
    if isinstance(network, DBN) and len(network) > 1 and not (run is not None and run.trained_jointly):
        if given is not None:
            raise UserError(
                f"given: a deep belief network of {len(network)} layers draws from its top layer, which does not "
                "see the columns. Train with model=one_layer, model=rbm or pretrain=joint for this."
            )
        return _from_the_top(network, n, _Reading(run, network[0].visible), 1 / temperature, settings)
    energy_model: EnergyModel = run.model if run is not None else _only_layer(network)
    require(energy_model.replicas == (), "replicas of the model", energy_model.replicas, "(): take one of them")
    reading = _Reading(run, energy_model.visible)
    require_finite(energy_model)
    energy_model = energy_model if temperature == 1 else tempered(energy_model, 1 / temperature)
    if given is None:
        return Samples(*draw(Target(energy_model), n, kept=reading.kept, **settings))
    rows = given if isinstance(given, Rows) else reading.row(given)
    return _completed(energy_model, rows, n, reading, settings)


class _Reading(NamedTuple):
    """How values of visible units stand for data.

    Attributes:
        run: Whose data; None of a model by itself.
        units: The visible units.
    """

    run: Run | None
    units: Units

    @property
    def of_intensities(self) -> bool:
        """Whether the data are kept as grey values."""
        return self.run is not None and self.run.schema is not None and self.run.schema.units() is None

    def kept(self, x: Tensor) -> Tensor:
        """Numbers of the sites, of values of all units."""
        return self.units.to_intensity(x) if self.of_intensities else self.units.decode(x).to(x.dtype)

    def values(self, rows: Rows) -> Tensor:
        """Values of the units, of numbers of the sites."""
        kept = self.units.from_intensity(rows.v) if self.of_intensities else rows.v
        return self.units.encode(kept)

    def row(self, given: Mapping[str, Any]) -> Rows:
        """What is known in the user's words."""
        if self.run is None:
            raise UserError("given: columns have names in a run alone; give Rows.")
        return given_row(self.run.needed_schema, given)

    def some(self, entries: Tensor) -> "_Reading":
        """The same of some entries."""
        return self._replace(units=self.units.select(entries))


def _completed(model: EnergyModel, rows: Rows, n: int, reading: _Reading, settings: dict[str, Any]) -> Samples:
    """Rows with gaps, each completed n times."""
    kept = rows.v.repeat_interleave(n, dim=0)
    if rows.observed is None or bool(rows.observed.all()):
        require(rows.n > 1, "given", "all columns", "some of the columns, so that others can be drawn")
        return Samples(kept, Mixing.of_independent(0, "no row has gaps"))
    gaps = (~rows.observed.all(-1)).nonzero().flatten()
    of_sites = rows.observed[gaps]
    v = reading.values(rows.at(gaps)).to(model.b)
    observed = reading.units.over_sites(of_sites).to(v.device)
    reading.units.check(v, observed)
    if len(gaps) == 1 and isinstance(model, RBM):
        rest = ~observed[0]
        target = Target(conditioned(model, v[0], observed[0]))
        drawn, mixing = draw(target, n, kept=reading.some(rest.nonzero().flatten()).kept, **settings)
        full = kept.new_zeros(n, rows.v.shape[-1])
        full[:, ~of_sites[0]] = drawn.to(kept)
    else:
        full, mixing = draw(Target(model, v, observed), n, kept=reading.kept, **settings)
    wide = of_sites.repeat_interleave(n, dim=0)
    at = (gaps.unsqueeze(-1) * n + torch.arange(n, device="cpu")).flatten()
    kept[at] = torch.where(wide, kept[at], full.to(kept))
    return Samples(kept, mixing)


def _from_the_top(dbn: DBN, n: int, reading: _Reading, beta: float, settings: dict[str, Any]) -> Samples:
    """Samples of the top RBM, drawn down to the data."""
    require(dbn.replicas == (), "replicas of the network", dbn.replicas, "(): take one of them")
    for rbm in dbn:
        require_finite(rbm)
    top = dbn[len(dbn) - 1]
    x, mixing = draw(Target(top if beta == 1 else tempered(top, beta)), n, kept=lambda x: x, **settings)
    for rbm in reversed(list(dbn)[:-1]):
        x = rbm.draw_visible(x, generator=settings["generator"])
    reason = "of the top layer, drawn layer by layer down to the data"
    reason = f"{mixing.reason}; {reason}" if mixing.reason else reason
    return Samples(reading.kept(x), replace(mixing, reason=reason))


def _only_layer(network: Any) -> EnergyModel:
    found: EnergyModel = network[0] if isinstance(network, DBN) else network
    return found


def _is_positive(x: object) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x) and x > 0
