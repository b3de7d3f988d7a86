"""A training of an energy model on a table, measured on the way by held-out rows, and at its end by test rows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.ambient import in_one_thread
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import log_likelihood_or_bound, log_partition_function
from memcomp_lightning.likelihood.both_ways import estimate_both_ways
from memcomp_lightning.models import EnergyModel, stacked
from memcomp_lightning.studies.accuracy import Progress
from memcomp_lightning.studies.density.settings import Density
from memcomp_lightning.studies.likelihood import measured_passes, warm_up
from memcomp_lightning.studies.measures.gradient_bias import without_diverged
from memcomp_lightning.studies.plan import Trial, passes_without_trainer, pretraining_of, require_bits
from memcomp_lightning.studies.records import Record
from memcomp_lightning.training import DivergedError
from memcomp_lightning.training.best import BestPass

ENUMERATED, ENUMERATED_AT_END = 16, 25
"""Units of the smaller layer up to which log Z is exact, along a training and at its end."""

THOROUGH = 10
"""How many times the steps of AIS are made where a pass looks best so far: it may look so by an estimate of log Z
that missed more of it than others did. The lower of both likelihoods counts."""

SWEEPS = 200
"""From training rows to the states from which reverse AIS starts."""


class Scores(NamedTuple):
    """Mean log-likelihood of rows in nats by both estimates of log Z, and how good these are; ``(*replicas,)``.

    Attributes:
        up: By AIS, which tends to flatter; exact where log Z is.
        down: By reverse AIS.
        standard_error: Of the larger of both.
    """

    up: Tensor
    down: Tensor
    standard_error: Tensor

    @property
    def least(self) -> Tensor:
        """The lower of both, which flatters no model."""
        return torch.minimum(self.up, self.down)


@dataclass(frozen=True, kw_only=True)
class DensityTrial(Trial):
    """All seeds of one model at one setting on one table.

    Attributes:
        density: What it is part of.
        seeds: Of the replicas.
        points: Passes after which they are measured; the last one ends training.
    """

    density: Density
    seeds: tuple[int, ...]
    points: tuple[int, ...]

    @property
    def n_updates(self) -> int:
        """Of the progress bar: passes."""
        return self.points[-1]

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.data_set}, {self.method}, {self.setting}"

    @in_one_thread()
    def run(self, progress: Progress) -> list[Record]:
        """Train until held-out rows say stop; test rows are looked at once, and never where a setting is chosen.

        It runs on one thread and counts seconds of the processor; measurements do not count.
        """
        plans = [self.build({**self.settings, "seed": seed}) for seed in self.seeds]
        stage, module = pretraining_of(plans[0])
        require_bits(stage.data, "seeds")
        network, data = stacked([plan.network for plan in plans], ()), stage.data
        batches = data.train_batches(0, 1).repeated(self.seeds)
        assert plans[0].stage_for is not None
        own_stage = plans[0].stage_for(network)
        trained = cast(Any, own_stage.phases[0].model)
        warm_up(trained, module, next(iter(batches)).v)
        (train, _), (held_out, _) = data.train, data.heldout
        measured = dict[str, list[list[float]]](valid=[], train=[], log_z_gap=[])
        record = Record.of(self, at=[], seconds=[], measures=measured)
        updates, best = sum(batch.closes_step for batch in batches), BestPass(patience=self.density.patience)
        passes = passes_without_trainer(module, batches, stage=own_stage, seed=self.seeds[0])
        try:
            for done, seconds in measured_passes(passes, self.points, progress, self.title):
                model, diverged = without_diverged(trained)
                betas, chains = self.density.quick_betas, self.density.chains
                of_rows = scores_of(model, train, [held_out, train], betas, chains, enumerated=ENUMERATED)
                valid = of_rows[0].least.masked_fill(diverged, -math.inf)
                looks_best = best.value is None or bool((valid > best.value).any())
                if looks_best and model.n_enumerated > ENUMERATED:
                    thorough = scores_of(model, train, [held_out], THOROUGH * betas, chains, enumerated=ENUMERATED)
                    valid = torch.minimum(valid, thorough[0].least)
                best.offer(valid, trained.state_dict())
                record.at.append(done.number * updates)
                record.seconds.append(seconds)
                for name, value in zip(
                    measured, (valid, of_rows[1].least, of_rows[0].up - of_rows[0].down), strict=True
                ):
                    measured[name].append(value.tolist())
                if best.over:
                    break
        except (DivergedError, SettingError):  # the second is a solver's that is given NaN
            pass
        if best.value is None:
            return [self._diverged(record)]
        record = replace(record, held_out=float(best.value.median()))
        if self.choosing:
            return [record]
        trained.load_state_dict(best.weights)
        (test, _), betas = data.test, self.density.betas
        scores = scores_of(trained, train, [test, held_out], betas, 2 * self.density.chains)
        base = independent_bits(train, test)
        found = {"test": scores[0].up, "test_reverse": scores[0].down, "standard_error": scores[0].standard_error}
        found |= {"valid_best": scores[1].least, "independent": base.expand_as(scores[0].up)}
        return [replace(record, measures={**measured, **{name: [x.tolist()] for name, x in found.items()}})]

    def _diverged(self, record: Record) -> Record:
        """What is left of a training that diverged before it was measured: it loses."""
        unknown = [[math.nan] * len(self.seeds)]
        measures = dict.fromkeys(("valid", "train", "log_z_gap"), unknown)
        if not self.choosing:
            names = ("test", "test_reverse", "standard_error", "valid_best", "independent")
            measures |= dict.fromkeys(names, unknown)
        return replace(record, held_out=-math.inf, at=[0], seconds=[0.0], measures=measures)


@torch.no_grad()
def scores_of(
    model: EnergyModel,
    train: Tensor,
    rows: Sequence[Tensor],
    betas: int,
    chains: int,
    *,
    enumerated: int = ENUMERATED_AT_END,
) -> list[Scores]:
    """Scores of sets of rows, by one log Z; exact where the smaller layer is small enough."""
    if model.n_enumerated <= enumerated:
        up = down = log_partition_function(model)
        error = torch.zeros_like(up)
    else:
        # Files may be sorted.
        order = torch.randperm(len(train), generator=rng.stream(0, "rows"), device="cpu")
        found = estimate_both_ways(model, train[order], n_chains=chains, n_betas=betas, n_sweeps=SWEEPS, seed=0)
        up, down, error = found.up.log_z, found.down.log_z, found.standard_error
    of_rows = [log_likelihood_or_bound(model, v, torch.zeros_like(up)).double().mean(-1) for v in rows]
    return [Scores(mean - up, mean - down, error) for mean in of_rows]


def independent_bits(train: Tensor, rows: Tensor) -> Tensor:
    """Mean log-likelihood of rows by independent bits with the means of training rows, one more of each value."""
    p = (train.double().sum(0) + 1) / (len(train) + 2)
    return torch.where(rows > 0.5, p.log(), (-p).log1p()).sum(-1).mean()
