"""scikit-learn's BernoulliRBM: persistent chains, one Gibbs step an update, float32, mini-batches of ten rows."""

import numpy as np
from bits import Rows
from numpy.typing import NDArray
from sklearn.neural_network import BernoulliRBM


def rbm(
    train: Rows, valid: Rows, *, seed: int, n_components: int, learning_rate: float, n_iter: int
) -> dict[str, NDArray[np.float32]]:
    """``weight`` (n_hidden, n_visible), ``b`` of the visible units, ``c`` of the hidden ones."""
    model = BernoulliRBM(n_components=n_components, learning_rate=learning_rate, n_iter=n_iter, random_state=seed)
    model.fit(train.astype(np.float32))
    parts = {"weight": model.components_, "b": model.intercept_visible_, "c": model.intercept_hidden_}
    return {name: np.asarray(part, np.float32) for name, part in parts.items()}
