"""Features of rows: the means of hidden units."""

import torch

from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import Columns
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models import DBN
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.values import complete_values


@torch.no_grad()
def transform(run: Run, rows: Rows, *, layer: int | None = None) -> Columns:
    r"""Means of the hidden units of a layer given each row, as columns ``h1``, ``h2``, ...

    Those of a deep belief network follow layer by layer, each from the means of the one below; a Boltzmann
    machine gives those of all hidden units, in the mean field.

    Args:
        run: A trained run.
        rows: Without missing values.
        layer: From 1; None is the top one.

    Raises:
        UserError, SettingError: A value is missing; there is no such layer.
    """
    run.require_pretrained()
    v, network = complete_values(run, rows), run.network
    n_layers = len(network) if isinstance(network, DBN) else 1
    if layer is not None:
        require_count("layer", layer)
        require(layer <= n_layers, "layer", layer, f"an integer from 1 to {n_layers}")
    if isinstance(network, DBN):
        h = v
        for rbm in list(network)[: layer or n_layers]:
            h = rbm.hidden_mean(h)
    else:
        h = run.model.hidden_mean(v)
    numbers = h.cpu().numpy()
    return {f"h{k + 1}": numbers[:, k] for k in range(numbers.shape[1])}
