"""How likely rows are under a trained model, and which class they have."""

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.data.schema import Columns
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.likelihood import log_likelihood_or_bound, log_pseudo_likelihood
from memcomp_lightning.likelihood.layers import NUMBERS
from memcomp_lightning.likelihood.missing import MissingChains, finders, of_observed
from memcomp_lightning.likelihood.missing.choice import MOST_MISSING_BITS
from memcomp_lightning.likelihood.values import has_row_sums
from memcomp_lightning.models import DBN, EnergyModel
from memcomp_lightning.trained.partition import Annealing, LogZ, log_z_of
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.values import values

CLASS_DRAWS = 100
"""Of what is missing of a row, over which its class probabilities are averaged."""

_ROWS_AT_ONCE = 128


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of rows.

    Attributes:
        columns: ``row``, from 1, and what :func:`score` says.
        log_z: Log Z and how it was found; None where there is no likelihood.
        seconds: That it took to find it.
        accuracy: Share of the labelled rows that have a class whose class is right; None without any.
        n_judged: How many these are.
        notes: What was left out, and why, a sentence each.
    """

    columns: Columns
    log_z: LogZ | None
    seconds: float
    accuracy: float | None
    notes: list[str]
    n_judged: int = 0


@torch.no_grad()
def score(
    run: Run,
    rows: Rows,
    *,
    pseudo: bool = True,
    annealing: Annealing | None = None,
    log_z: LogZ | None = None,
    seed: int = 0,
) -> Scores:
    r"""Score rows, as columns.

    * ``log_likelihood``: log p(v) in nats; of rows with gaps log p(observed values). Of real columns it is the log
      of a density in the user's units.
    * ``log_likelihood_error``: its standard error, where log Z or a sum over missing values is estimated. The
      error of log Z is one and the same for all rows.
    * ``free_energy``: F, so that ``log_likelihood`` is -F - log Z, in the units of the model.
    * ``pseudo_log_likelihood``: :math:`\sum_j \log p(v_j | v_{-j})`, which needs no log Z; NaN of rows with gaps.
    * ``p(CLASS)`` and ``class`` of the fine-tuned network, if there is one. Rows with gaps have the mean over
      :data:`CLASS_DRAWS` draws of what is missing, by the model of the data: exact ones where it is small, else of
      chains whose agreement is measured; they are empty where the run has no such model.

    Args:
        run: A trained run.
        rows: To score; whole rows may be missing.
        pseudo: Whether pseudo-likelihoods are computed; of many real columns they take longest.
        annealing: Settings of AIS.
        log_z: Log Z, where it is known; None finds it.
        seed: Of what is drawn.

    Raises:
        UserError, SettingError: The run has neither an energy model nor a classifier; values that have no
            likelihood, in a run without a classifier.
    """
    v, observed = values(run, rows)
    whole = torch.ones(len(v), dtype=torch.bool) if rows.observed is None else rows.observed.all(-1)
    columns: Columns = {"row": np.arange(1, len(v) + 1)}
    notes: list[str] = []
    seconds = 0.0
    try:
        model = run.model
        model.visible.check(v, observed, pure=True)
    except (UserError, SettingError) as error:
        if run.classifier is None:
            raise
        notes.append(f"no likelihoods: {error}")
    else:
        begin = time.perf_counter()
        try:
            log_z = log_z or log_z_of(model, annealing=annealing, seed=seed)
        except UserError as error:
            notes.append(f"no log_likelihood: {error}")
        seconds = time.perf_counter() - begin
        columns |= _likelihoods(run, model, _Given(rows, v, observed, whole), log_z, notes, seed)
        if pseudo:
            columns |= _pseudo_likelihoods(run, model, v, whole, notes)
    accuracy, n_judged = None, 0
    if run.classifier is not None:
        of_classes, accuracy, n_judged = _classes(run, _Given(rows, v, observed, whole), notes, seed)
        columns |= of_classes
    return Scores(columns, log_z, seconds, accuracy, notes, n_judged)


@torch.no_grad()
def log_likelihoods(run: Run, rows: Rows, log_z: LogZ, *, seed: int = 0) -> NDArray[np.float64]:
    """The column ``log_likelihood`` of :func:`score`, where log Z is known."""
    v, observed = values(run, rows)
    whole = torch.ones(len(v), dtype=torch.bool) if rows.observed is None else rows.observed.all(-1)
    run.model.visible.check(v, observed, pure=True)
    found: NDArray[np.float64] = _likelihoods(run, run.model, _Given(rows, v, observed, whole), log_z, [], seed)[
        "log_likelihood"
    ]
    return found


class _Given(NamedTuple):
    """Rows, their values and masks of the visible units, and which have no gaps."""

    rows: Rows
    v: Tensor
    observed: Tensor | None
    whole: Tensor


def _likelihoods(
    run: Run, model: EnergyModel, given: _Given, log_z: LogZ | None, notes: list[str], seed: int
) -> Columns:
    """Log-likelihoods and free energies."""
    rows, v, observed, whole = given
    minus_free, error = torch.full((2, len(v)), torch.nan, dtype=torch.float64)
    error[whole] = 0.0
    at = whole.nonzero().flatten()
    if len(at):
        minus_free[at] = log_likelihood_or_bound(model, v[at], v.new_zeros((), dtype=torch.float64))
    if not has_row_sums(model):
        notes.append("log_likelihood is a lower bound, in the mean field: hidden units are coupled to each other")
    at = (~whole).nonzero().flatten()
    if observed is not None and len(at):
        try:
            minus_free[at], error[at] = of_observed(model, v[at], observed[at], generator=rng.stream(seed, "gaps"))
        except SettingError as reason:
            notes.append(f"no likelihoods of rows with gaps: {reason}")
        else:
            if n_without := int(minus_free[at].isnan().sum()):
                notes.append(
                    f"{n_without:,} rows with gaps have no likelihood: more than {2**MOST_MISSING_BITS:,} "
                    "combinations of values may be missing, and visible units are coupled to each other"
                )
    found: dict[str, Tensor] = {}
    if log_z is not None:
        found["log_likelihood"] = minus_free - log_z.value - _log_scale(run, rows)
        error = (error.square() + log_z.error**2).sqrt()
        if bool((error > 0).any()):
            found["log_likelihood_error"] = error
    found["free_energy"] = -minus_free
    return {name: column.numpy() for name, column in found.items()}


def _log_scale(run: Run, rows: Rows) -> Tensor:
    """What a log density of the units of each row is above one in the user's units, of what is observed."""
    scales = torch.tensor(getattr(run.needed_schema, "log_scales", [0.0] * rows.v.shape[-1]), dtype=torch.float64)
    return scales.sum() if rows.observed is None else rows.observed.double() @ scales


def _pseudo_likelihoods(run: Run, model: EnergyModel, v: Tensor, whole: Tensor, notes: list[str]) -> Columns:
    found = torch.full((len(v),), torch.nan, dtype=torch.float64)
    try:
        if bool(whole.any()):
            found[whole] = log_pseudo_likelihood(model, v[whole]).sum(-1) - run.needed_schema.log_scale
    except SettingError as reason:
        notes.append(f"no pseudo-likelihoods: {reason}")
        return {}
    return {"pseudo_log_likelihood": found.numpy()}


def _classes(run: Run, given: _Given, notes: list[str], seed: int) -> tuple[Columns, float | None, int]:
    """Probabilities of the classes, the likeliest one, and the share that is right of so many rows."""
    rows, v, observed, whole = given
    names, known = run.needed_schema.class_names, whole.clone()
    p = torch.full((len(v), len(names)), torch.nan)
    if bool(whole.any()):
        p[whole] = _probabilities(run, v[whole])
    n_gaps, model = int((~whole).sum()), _of_data(run)
    if n_gaps and observed is not None and model is not None:
        p[~whole], n_apart = _mean_probabilities(run, model, v[~whole], observed[~whole], seed)
        known[:] = True
        apart = f"; the chains of {n_apart:,} of them do not agree yet" if n_apart else ""
        notes.append(
            f"classes of {n_gaps:,} rows with gaps: means over {CLASS_DRAWS} draws of what is missing{apart}"
        )
    elif n_gaps:
        notes.append(
            f"{n_gaps:,} rows with gaps have no class: this run was not pretrained, so nothing fills them"
        )
    best = p.argmax(-1)
    of_class = np.array([names[k] for k in best.tolist()], dtype=object)
    of_class[~known.numpy()] = None
    columns: Columns = {f"p({name})": p[:, k].numpy() for k, name in enumerate(names)}
    judged = known & (rows.label != UNLABELLED)
    right = float((best == rows.label)[judged].double().mean()) if bool(judged.any()) else math.nan
    return columns | {"class": of_class}, None if math.isnan(right) else right, int(judged.sum())


def _of_data(run: Run) -> EnergyModel | None:
    """The model that draws what is missing of inputs: of a stack its first layer, or all if trained jointly."""
    if not run.pretrained:
        return None
    if isinstance(run.network, DBN) and not run.trained_jointly:
        return run.network[0]
    return run.model


def _probabilities(run: Run, v: Tensor) -> Tensor:
    """Class probabilities of values without gaps, ``(n, n_classes)``."""
    assert run.classifier is not None
    some = v.to(next(run.classifier.parameters()))
    logits = torch.cat([run.classifier(part) for part in some.split(4096)]).float()
    # By squared errors each class is learned by itself, and the outputs need not add up to one.
    by_squares = (run.settings or {}).get("finetune", {}).get("loss") == "squared_error"
    return logits.sigmoid() if by_squares else torch.softmax(logits, dim=-1)


def _mean_probabilities(
    run: Run, model: EnergyModel, v: Tensor, observed: Tensor, seed: int
) -> tuple[Tensor, int]:
    """Their means over draws of what is missing, and the number of rows whose chains do not agree."""
    generator, n_apart = rng.stream(seed, "gaps of a classifier"), 0
    chains = MissingChains()
    found = torch.empty(len(v), len(run.needed_schema.class_names))
    for finder, rows in finders(model, observed, chains):
        at_once = max(1, min(_ROWS_AT_ONCE, NUMBERS // finder.numbers_a_row(model, CLASS_DRAWS)))
        for some in rows.split(at_once):
            draws = finder.find(model, v[some], observed[some], m=CLASS_DRAWS, generator=generator)
            n_apart += int((draws.r_hat > chains.r_hat).sum())
            of_draws = _probabilities(run, draws.draws.flatten(0, 1)).unflatten(0, draws.draws.shape[:2])
            found[some] = of_draws.mean(0).to(found)
    return found, n_apart
