"""What the sampler reports, and how well its chains mix."""

from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.base import EveryIterations, log_scalars, model_of, prefix_of, required
from memcomp_lightning.errors import require_count
from memcomp_lightning.models.units import Bernoulli, Units
from memcomp_lightning.samplers.base import holds_chains
from memcomp_lightning.types import Configurations


class SamplerDiagnostics(EveryIterations):
    """Logs ``negative_phase/<key>``: the sampler's ``info`` at the pass's last update, and mixing of its chains.

    For chains that persist from update to update there are two keys more:

    * ``bits_changed``: mean of ``|v - v at the last look|`` over units and chains, the share of bits that changed;
      of spins and categories ``sites_changed``, the share of sites, and of real units neither.
    * ``autocorrelation_time``: of the chains' energies from look to look, integrated, in passes; see
      :func:`autocorrelation_time`. It needs at least two looks and two chains. A value above a tenth of the
      passes that ``history`` spans means "at least so much".

    Chains count as persistent if the state that ``sampler.init`` returns holds visible states, or if there is no
    ``sampler``; weighted configurations are no chains. The series starts afresh with each layer, and is in
    checkpoints. With several processes all values are those of the first.

    Args:
        every: Passes between two looks, >= 1.
        history: Looks that the autocorrelation time takes in, >= 2.
    """

    def __init__(self, every: int = 1, history: int = 50) -> None:
        super().__init__(every)
        require_count("history", history, minimum=2)
        self.history = history
        self._stage = ""
        self._energies: list[Tensor] = []
        self._v: Tensor | None = None

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Report, and add to the series."""
        step = required(outputs, self, "negative")
        values = {**step.get("info", {}), **self._mixing(pl_module, step["negative"])}
        # What a sampler reports may depend on a draw of its process (mode-assisted training tosses a coin).
        tagged = {f"negative_phase/{key}": value for key, value in values.items()}
        log_scalars(pl_module, tagged, of_first_process=True)

    def _mixing(self, module: pl.LightningModule, negative: Configurations) -> dict[str, Tensor]:
        if negative.weight is not None or not chains_persist(module):
            return {}
        if prefix_of(module) != self._stage or self._v is None or self._v.shape != negative.v.shape:
            self._stage, self._energies, self._v = prefix_of(module), [], None
        values: dict[str, Tensor] = {}
        v = negative.v.detach().clone().cpu()  # a sampler of somebody else's may go on in the same tensor
        if self._v is not None:
            values |= _changed(model_of(module).visible, v, self._v)
        energy = model_of(module).energy(negative.v, negative.h).cpu()
        self._v, self._energies = v, [*self._energies, energy][-self.history :]
        if len(self._energies) >= 2 and energy.shape[-1] >= 2:
            series = torch.stack(self._energies, dim=-2)
            values["autocorrelation_time"] = self.every * autocorrelation_time(series)
        return values

    def state_dict(self) -> dict[str, Any]:
        """The series so far."""
        return {"stage": self._stage, "energies": self._energies, "v": self._v}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self._stage, self._energies, self._v = state_dict["stage"], state_dict["energies"], state_dict["v"]


def _changed(units: Units, v: Tensor, before: Tensor) -> dict[str, Tensor]:
    """The share of units that are not what they were, by its name."""
    change = (v - before).abs()
    if isinstance(units, Bernoulli):
        return {"bits_changed": change.mean((-1, -2))}
    if units.real:
        return {}
    site, shape = units.site_of().to(v.device), (*v.shape[:-1], units.n_sites)
    of_sites = v.new_zeros(shape).index_add_(-1, site, change)
    return {"sites_changed": (of_sites > 0).to(v.dtype).mean((-1, -2))}


def autocorrelation_time(series: Tensor) -> Tensor:
    r"""Integrated autocorrelation time ``1 + 2 \sum_t rho(t)`` of many chains that sample a changing model.

    At each time the chains' mean is taken off and their spread divided out, so that what all chains do together
    (training moves the model) does not count; rho(t) is the mean product of deviations t apart. The sum ends at
    the first lag of at least five times its value (Sokal 1997), or with the series. Times at which all chains
    are equal count as stuck.

    Args:
        series: ``(*replicas, n_times, n_chains)``, both >= 2.

    Returns:
        ``(*replicas,)`` float64, in steps of the series; 1 for independent values.

    >>> autocorrelation_time(torch.tensor([[0.0, 1.0], [1.0, 0.0]])).item()
    -1.0
    """
    series = series.double()
    deviation = series - series.mean(-1, keepdim=True)
    spread = deviation.square().mean(-1, keepdim=True).sqrt()
    z = torch.where(spread > 0, deviation / spread, 1.0)
    n = series.shape[-2]
    rho = torch.stack([(z[..., : n - lag, :] * z[..., lag:, :]).mean((-1, -2)) for lag in range(1, n)], dim=-1)
    time = 1 + 2 * rho.cumsum(-1)
    enough = torch.arange(1, n) >= 5 * time
    enough[..., -1] = True
    return time.take_along_dim(enough.int().argmax(-1, keepdim=True), dim=-1).squeeze(-1)


def chains_persist(module: pl.LightningModule) -> bool:
    """Whether the sampler's chains go on from update to update."""
    init = getattr(getattr(module, "sampler", None), "init", None)
    if init is None:
        return True
    model = model_of(module)
    widths = (model.n_visible, model.n_visible + model.n_hidden)
    return holds_chains(init(model, 1, generator=rng.stream(0, "check")), widths)
