"""Log-likelihood of training and held-out images, with log Z by enumeration or annealed importance sampling."""

import logging
from itertools import takewhile
from typing import Any, ClassVar, Literal, TypedDict, cast

import lightning.pytorch as pl
import torch
from torch import Generator, Tensor

from memcomp_lightning import likelihood, rng
from memcomp_lightning.callbacks.base import (
    EveryIterations,
    LastImages,
    images_of_step,
    iteration_of,
    log_scalars,
    mask_of_step,
    model_of,
    prefix_of,
    require_enumerable,
    required,
)
from memcomp_lightning.callbacks.sampler_diagnostics import chains_persist
from memcomp_lightning.errors import require_choice, require_count
from memcomp_lightning.likelihood.chains import MOST_BEHIND, log_z_from_chains, stopped_mixing
from memcomp_lightning.likelihood.values import MOST_HIDDEN
from memcomp_lightning.models import RBM, EnergyModel
from memcomp_lightning.models.machine import log2_states
from memcomp_lightning.models.observed import visible_units_coupled

QUICKLY_ENUMERATED = 16
"""Units that "auto" enumerates at most."""

QUICKLY_ANNEALED = 10**10
"""Products in all chains and steps of AIS that "auto" computes at most, see ``annealing_products``: a second."""


log = logging.getLogger(__name__)


class LikelihoodValue(TypedDict):
    """What one look of :class:`LogLikelihood` found.

    Attributes:
        layer: Index of the model among those that the module trains.
        iteration: Passes that the model had been trained for, from 1.
        method: "exact" or "ais", as log Z was found.
        train: Nats an image of the training images, one number a replica.
        heldout: The same of held-out images; empty if there was no validation at the end of the pass.
        gap: Nats by which log Z from persistent chains is too low, one number a replica; empty without them.
    """

    layer: int
    iteration: int
    method: str
    train: list[float]
    heldout: list[float]
    gap: list[float]


class LogLikelihood(EveryIterations):
    """Measures how well a model fits training and held-out images: log-likelihood in nats, mean over replicas.

    The names are ``log_likelihood_train`` and ``log_likelihood_heldout``, per image, and ``log_z``, of the model.
    Training images are those of the pass's last batches, about ``n_images`` of them; held-out images are those of
    a validation at the end of the pass, if there is one. Images that are not 0 or 1 have no likelihood under a
    Bernoulli model: each intensity is taken as the probability of a 1 and drawn, with a random stream of the
    callback's own, the same draws each time; so are means of spins and of categories. Of real units it is the log
    of a density. Where values are missing it is that of the observed ones, of models with up to 16 hidden units;
    of larger ones there is none. In upper layers of a stack the "images" are mean activations, drawn likewise, and
    the likelihood is that of the layer. For a Boltzmann machine with more than 16 hidden units that are coupled to
    each other the mean-field bound takes the place of the likelihood.

    Annealed importance sampling (AIS; Salakhutdinov & Murray 2008) starts at independent units with the means of
    the training images. Its estimate of log Z tends to be too small, and the likelihood too large;
    ``log_z_standard_error`` and ``log_z_effective_sample_size`` (out of ``n_chains``) say how far to trust it.

    Where the chains of an RBM's sampler persist from update to update (PCD, parallel tempering), reverse AIS
    begins at them, too. ``log_z_gap``, log Z by annealing less that from the chains, is about 0 while the chains
    are samples of the model. Chains that have stopped mixing sit in modes of little weight, and the gap grows, to
    ten nats and more: training then makes the likelihood worse. At two looks in a row above ``MOST_BEHIND`` nats,
    or at the last one, a warning names the remedy.

    Attributes:
        history: Every value so far, the oldest first; checkpoints keep it.

    Args:
        every: Passes between two values, >= 1; None means about ten values a stage.
        method: "exact" enumerates the smaller layer; "ais" estimates log Z at any size; "auto" enumerates up to 16
            units, estimates where that takes about a second at most, and gives no value of larger models.
        n_images: Training images a replica to judge, >= 1.
        max_units: Largest smaller layer to enumerate, >= 1.
        n_chains: Chains of AIS, >= 2.
        n_betas: Steps of AIS, >= 1.
        seed: Seed of the draws.

    Raises:
        SettingError: A setting out of range; at the start of training, a layer too large to enumerate.
    """

    looks_a_stage: ClassVar[int] = 10

    def __init__(
        self,
        every: int | None = None,
        method: Literal["auto", "exact", "ais"] = "auto",
        *,
        n_images: int = 1000,
        max_units: int = 25,
        n_chains: int = 100,
        n_betas: int = 300,
        seed: int = 0,
    ) -> None:
        super().__init__(1 if every is None else every)
        self._about_ten = every is None
        require_choice("method", method, ("auto", "exact", "ais"))
        require_count("max_units", max_units)
        require_count("n_chains", n_chains, minimum=2)
        require_count("n_betas", n_betas)
        self.method = method
        self.max_units = max_units
        self.n_chains = n_chains
        self.n_betas = n_betas
        self.seed = seed
        self.history: list[LikelihoodValue] = []
        self._train = LastImages(n_images)
        self._heldout: list[tuple[Tensor, int]] = []
        self._judged_at = -1
        self._bits: Generator | None = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Refuse models too large to enumerate; settle how often to look."""
        if self._about_ten:
            self.every = max(1, (trainer.max_epochs or 1) // self.looks_a_stage)
        if self.method == "exact":
            require_enumerable(self, pl_module, self.max_units)

    def on_train_epoch_start(self, *_: object) -> None:
        """Forget the last pass."""
        self._train = LastImages(self._train.n)
        self._heldout = []

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Keep the visible states of the last batches."""
        super().on_train_batch_end(trainer, pl_module, outputs)
        if self._looks(trainer, pl_module):
            self._train.add(images_of_step(outputs, self), mask_of_step(outputs))

    def on_validation_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start a new sum, and the draws of the same bits as before."""
        self._heldout = []
        self._judged_at = trainer.global_step
        self._bits = rng.stream(self.seed, "log_likelihood", 1)

    @torch.no_grad()
    def on_validation_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Unnormalised log-likelihood of one chunk of held-out images."""
        if self._looks(trainer, pl_module) and not trainer.sanity_checking and self._bits is not None:
            v, observed = required(outputs, self, "v")["v"], mask_of_step(outputs)
            if sums_missing(model_of(pl_module), observed):
                self._heldout.append((self._total(model_of(pl_module), v, observed, self._bits), v.shape[-2]))

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Normalise."""
        model = model_of(pl_module)
        method = self._method_for(model)
        if method is None:
            return
        train, observed = self._train.images(), self._train.observed()
        if not sums_missing(model, observed):
            self.leave_out(
                "missing values are summed for models of up to 16 hidden units, coupled to visible ones; "
                "memcomp-score gives likelihoods of others"
            )
            return
        values = self._partition_function(model, method, train, observed, _chains_of(pl_module, outputs))
        log_z = values["log_z"]
        if train is not None:
            total = self._total(model, train, observed, rng.stream(self.seed, "log_likelihood", 0))
            values["log_likelihood_train"] = total / train.shape[-2] - log_z
        # A validation in the middle of the pass has judged another model.
        judged = bool(self._heldout) and self._judged_at == trainer.global_step
        if judged:
            values["log_likelihood_heldout"] = self._mean_of_heldout(trainer) - log_z
        log_scalars(pl_module, values)
        gap = values.get("log_z_gap")
        self.history.append(
            LikelihoodValue(
                layer=int(getattr(pl_module, "layer", 0)),
                iteration=iteration_of(pl_module) + 1,
                method=method,
                train=values["log_likelihood_train"].flatten().tolist() if train is not None else [],
                heldout=values["log_likelihood_heldout"].flatten().tolist() if judged else [],
                gap=[] if gap is None else gap.flatten().tolist(),
            )
        )
        self._say_if_behind(pl_module)

    def _mean_of_heldout(self, trainer: pl.Trainer) -> Tensor:
        """Unnormalised, over the held-out images of all processes; those that each of them holds count alike."""
        total = torch.stack([total for total, _ in self._heldout]).sum(0)
        sums = torch.cat([total.reshape(-1), total.new_tensor([sum(n for _, n in self._heldout)])])
        if trainer.world_size > 1:
            sums = cast(Tensor, trainer.strategy.reduce(sums, reduce_op="sum"))
        return (sums[:-1] / sums[-1]).view_as(total)

    def state_dict(self) -> dict[str, Any]:
        """The values so far."""
        return {"history": list(self.history)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take back the values so far."""
        self.history = list(state_dict["history"])

    def _looks(self, trainer: pl.Trainer, module: pl.LightningModule) -> bool:
        """Whether the present pass ends with a value."""
        return self.is_due(trainer, module) and self._method_for(model_of(module)) is not None

    def _method_for(self, model: EnergyModel) -> Literal["exact", "ais"] | None:
        """How log Z of a model is found; None if it is not."""
        if self.method != "auto":
            return self.method
        if model.n_enumerated <= min(QUICKLY_ENUMERATED, self.max_units):
            return "exact"
        n_products = likelihood.annealing_products(model, self.n_chains, self.n_betas)
        return "ais" if n_products <= QUICKLY_ANNEALED else None

    def _partition_function(
        self, model: EnergyModel, method: str, train: Tensor | None, observed: Tensor | None, chains: Tensor | None
    ) -> dict[str, Tensor]:
        """``log_z`` and, where it is an estimate, how good it is; ``log_z_gap`` where chains persist."""
        base = None if train is None else likelihood.base_of(train, model.visible, observed)
        down = None
        if chains is not None and isinstance(model, RBM):
            down = log_z_from_chains(model, chains, base=base, n_betas=self.n_betas, seed=self.seed)
        if method == "exact":
            log_z = likelihood.log_partition_function(model, max_units=self.max_units)
            return {"log_z": log_z} if down is None else {"log_z": log_z, "log_z_gap": log_z - down}
        ais = likelihood.Ais(n_chains=self.n_chains, n_betas=self.n_betas)
        estimate = ais.estimate(model, generator=rng.stream(self.seed, "log_likelihood", 2), base=base)
        values = {
            "log_z": estimate.log_z,
            "log_z_standard_error": estimate.standard_error,
            "log_z_effective_sample_size": estimate.effective_sample_size,
        }
        return values if down is None else {**values, "log_z_gap": estimate.log_z - down}

    def _say_if_behind(self, module: pl.LightningModule) -> None:
        """Warn where the chains are no samples of the model any more: at the second look in a row, or the last."""
        newest = self.history[-1]
        looks = (value for value in reversed(self.history) if value["layer"] == newest["layer"])
        behind_so_far = sum(
            1 for _ in takewhile(lambda value: max(value["gap"], default=0.0) > MOST_BEHIND, looks)
        )
        is_last = newest["iteration"] == getattr(module, "iterations", None)
        if behind_so_far == 2 or (is_last and behind_so_far == 1):
            log.warning("%s, pass %d: %s", prefix_of(module), newest["iteration"], behind(max(newest["gap"])))

    @staticmethod
    def _total(model: EnergyModel, v: Tensor, observed: Tensor | None, bits: Generator) -> Tensor:
        """Sum over images of values of the units of log p(v) + log Z, ``(*replicas,)`` float64."""
        log_z = v.new_zeros(model.replicas, dtype=torch.float64)
        v = model.visible.values_of(v, generator=bits)
        if observed is not None:
            return likelihood.log_likelihood(model, v, log_z, observed=observed).sum(-1)
        return likelihood.log_likelihood_or_bound(model, v, log_z).double().sum(-1)


def behind(gap: float) -> str:
    """What a gap above :data:`MOST_BEHIND` means, and what to do."""
    return (
        f"{stopped_mixing(gap)}, and the likelihood falls where that goes on. Let the learning rate fall "
        "(pretrain=falling), take more chains (sampler.n_chains=500), or chains at several temperatures "
        "(sampler=tempering)."
    )


def _chains_of(module: pl.LightningModule, outputs: object) -> Tensor | None:
    """Visible states of chains that go on from update to update; None without."""
    negative = outputs.get("negative") if isinstance(outputs, dict) else None
    if negative is None or negative.weight is not None or negative.v.shape[-2] < 2:
        return None
    if not hasattr(module, "sampler") or not chains_persist(module):
        return None
    v: Tensor = negative.v
    return v


def sums_missing(model: EnergyModel, observed: Tensor | None) -> bool:
    """Whether the likelihood of data with this mask can be computed."""
    if observed is None:
        return True
    few = not model.hidden.real and log2_states(model.hidden) <= MOST_HIDDEN
    return few and not visible_units_coupled(model)
