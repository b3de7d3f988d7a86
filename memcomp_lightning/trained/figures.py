"""Figures of a trained run: samples against data, and how likely both are."""

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.against_samples import frequencies, has_categories, letters_in
from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.data.shown import Shown
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.models import EnergyModel
from memcomp_lightning.plotting.against_data import plot_against_data
from memcomp_lightning.plotting.likelihoods import plot_likelihoods
from memcomp_lightning.plotting.logo import plot_logo
from memcomp_lightning.plotting.state_frequencies import plot_state_frequencies
from memcomp_lightning.trained.partition import LogZ
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.sampling import sample
from memcomp_lightning.trained.scoring import log_likelihoods
from memcomp_lightning.trained.training_rows import training_rows
from memcomp_lightning.trained.values import values, visible_of

N_SAMPLES = 1000
"""Of the model, beside scores."""

_MOST_SITES = 128
"""Of sequence logos."""


@torch.no_grad()
def figures_of(
    run: Run, data: Rows, samples: Tensor, *, heldout: Rows | None = None, seed: int = 0
) -> dict[str, Figure]:
    """Samples against data: ``marginals``, ``correlations``, ``plane``, ``free_energies``; of sequences ``logos``.

    What each shows: :mod:`memcomp_lightning.plotting`. Free energies are those of rows without gaps, where the run
    has an energy model; of sequences there are ``state_frequencies``, too.

    Args:
        run: A trained run.
        data: Rows of the data, with or without gaps and weights.
        samples: Numbers of the sites, as the data are kept, ``(n, n_sites)``.
        heldout: Rows that were not trained on: the ceiling of what a model can reach.
        seed: Of draws, where data are means in between, as grey values are.
    """
    units, schema, generator = visible_of(run), run.needed_schema, rng.stream(seed, "figures")
    seen = _shown(run, data, generator)
    drawn = Shown(units, units.encode(samples, check=False), schema=schema)
    others = None if heldout is None else _shown(run, heldout, generator)
    found = plot_against_data(seen, drawn, others)
    letters = letters_in(schema)
    if letters is not None and has_categories(units):
        tables = {
            name: frequencies(units, rows.v, rows.observed, rows.weight).numpy()
            for name, rows in (("data", seen), ("samples", drawn))
        }
        found["logos"] = plot_logo({name: x[:_MOST_SITES] for name, x in tables.items()}, alphabet=letters)
        found["state_frequencies"] = plot_state_frequencies(tables["data"], tables["samples"], alphabet=letters)
    model = _energy_model(run)
    complete = {"data": seen.complete, "samples": drawn}
    if others is not None:
        complete["held-out data"] = others.complete
    if model is not None and len(complete["data"].v):
        minus = {name: -model.free_energy(rows.v).double().numpy() for name, rows in complete.items()}
        weights = {name: rows.weights for name, rows in complete.items() if rows.weights is not None}
        found["free_energies"] = plot_likelihoods(minus, weights=weights, xlabel="minus free energy (nats)")
    return found


@torch.no_grad()
def figure_of_scores(
    run: Run, rows: Rows, scored: NDArray[np.floating], log_z: LogZ, *, name: str = "rows", seed: int = 0
) -> tuple[Figure, list[str]]:
    """Log-likelihoods of scored rows, of the training and held-out data of the run, and of samples of its model.

    Args:
        run: A trained run with an energy model.
        rows: That were scored.
        scored: Their log-likelihoods.
        log_z: Log Z of the model.
        name: Of the scored rows.
        seed: Of the samples.

    Returns:
        The figure, and what is left out or doubtful, a sentence each.
    """
    notes, sets = [], {name: rows}
    try:
        data = training_rows(run)
    except UserError as error:
        notes.append(f"the figure leaves out the data of the run: {error}")
    else:
        sets |= {"training data": data.train, "held-out data": data.heldout}
    drawn, mixing = sample(run, N_SAMPLES, seed=seed)
    if mixing.warning is not None:
        notes.append(f"samples of the figure: {mixing.warning}")
    sets["samples"] = Rows(drawn, torch.full((len(drawn),), UNLABELLED, device="cpu"))
    # In this order they have the colours that they have in other figures.
    names = ("training data", "samples", "held-out data", name) if len(sets) > 2 else (name, "samples")
    shown: dict[str, NDArray[np.floating]] = {}
    weights: dict[str, NDArray[np.floating]] = {}
    n_gaps = 0
    for kind in names:
        own = sets[kind]
        whole = torch.ones(own.n, dtype=torch.bool) if own.observed is None else own.observed.all(-1)
        if not bool(whole.any()):
            notes.append(f"the figure leaves out the {kind}: all of them have gaps")
            continue
        n_gaps += int((~whole).sum())
        at = whole.nonzero().flatten()
        try:
            shown[kind] = (
                scored[at.numpy()] if kind == name else log_likelihoods(run, own.at(at), log_z, seed=seed)
            )
        except SettingError as error:  # grey values in between
            notes.append(f"the figure leaves out the {kind}: {error}")
            continue
        if own.weight is not None:
            weights[kind] = own.weight[at].double().numpy()
    if n_gaps:
        notes.append(f"the figure leaves out {n_gaps:,} rows with gaps, whose likelihoods are of fewer values")
    return plot_likelihoods(shown, weights=weights), notes


def _shown(run: Run, rows: Rows, generator: Generator) -> Shown:
    """Rows as values of the units."""
    v, observed = values(run, rows)
    return Shown(visible_of(run), v, observed, rows.weight, run.needed_schema).drawn(generator)


def _energy_model(run: Run) -> EnergyModel | None:
    """The energy model of the data; None of a stack that has none."""
    try:
        return run.model
    except UserError:
        return None
