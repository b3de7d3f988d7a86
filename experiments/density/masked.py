"""MADE, a masked autoregressive network of one hidden layer.

    log p(x) = sum_i log p(x_i | x of columns that come before i in an order)

Source: M. Germain, K. Gregor, I. Murray and H. Larochelle, "MADE: Masked autoencoder for distribution estimation",
ICML 2015, with direct connections from inputs to outputs, and with its training over several orders: one set of
weights, another mask at each update, and as the model the mean of the distributions of all masks.
"""

import copy
import math

import numpy as np
import torch
from bits import Fitted, Real, Rows, smoothed_means
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, linear

torch.set_num_threads(1)

_BATCH = 100
_UPDATES, _UPDATES_AT_LEAST_BETWEEN, _PATIENCE = 20_000, 100, 15
_ROWS_AT_ONCE = 2000


class Masks:
    """Which weights stay so that an output sees only columns that come before its own in ``order``.

    Attributes:
        enter: Of input to hidden units, ``(n_hidden, n_visible)``.
        leave: Of hidden units to outputs, ``(n_visible, n_hidden)``.
        direct: Of input to outputs, ``(n_visible, n_visible)``.
    """

    def __init__(self, order: Tensor, degree: Tensor) -> None:
        self.enter = (degree[:, None] >= order[None]).float()
        self.leave = (order[:, None] > degree[None]).float()
        self.direct = (order[:, None] > order[None]).float()


class MaskedNetwork(nn.Module):
    """One set of weights under ``masks`` masks; the first order is that of the columns."""

    def __init__(self, means: Real, n_hidden: int, masks: int, generator: torch.Generator) -> None:
        super().__init__()
        n = len(means)

        def uniform(rows: int, columns: int) -> nn.Parameter:
            bound = math.sqrt(6 / (rows + columns))
            return nn.Parameter(torch.empty(rows, columns).uniform_(-bound, bound, generator=generator))

        self.enter, self.leave = uniform(n_hidden, n), uniform(n, n_hidden)
        self.direct = nn.Parameter(torch.zeros(n, n))
        self.hidden = nn.Parameter(torch.zeros(n_hidden))
        self.out = nn.Parameter(torch.tensor(np.log(means / (1 - means)), dtype=torch.float32))
        self.masks = []
        for k in range(masks):
            order = torch.arange(n) if k == 0 else torch.randperm(n, generator=generator)
            self.masks.append(Masks(order, torch.randint(max(n - 1, 1), (n_hidden,), generator=generator)))

    def logits(self, x: Tensor, mask: Masks) -> Tensor:
        """Of p(x_i = 1 | the columns before), ``(rows, n_visible)``."""
        h = torch.relu(linear(x, self.enter * mask.enter, self.hidden))
        return linear(h, self.leave * mask.leave, self.out) + linear(x, self.direct * mask.direct)

    def of_mask(self, x: Tensor, mask: Masks) -> Tensor:
        """log p(x) under one mask, ``(rows,)``."""
        return -binary_cross_entropy_with_logits(self.logits(x, mask), x, reduction="none").sum(1)

    @torch.no_grad()
    def log_likelihood(self, rows: Rows) -> Real:
        """Of the mean of the masks' distributions, ``(rows,)``."""
        parts = [torch.from_numpy(rows[k : k + _ROWS_AT_ONCE]).float() for k in range(0, len(rows), _ROWS_AT_ONCE)]
        each = [torch.stack([self.of_mask(x, mask) for mask in self.masks]) for x in parts]
        total = torch.cat([part.logsumexp(0) for part in each]) - math.log(len(self.masks))
        return np.asarray(total.double().numpy())


class Adam:
    """Adam with decoupled weight decay of matrices; torch's own imports sympy at its first step, for a second."""

    def __init__(self, network: nn.Module, rate: float, decay: float) -> None:
        self.rate, self.decay, self.steps = rate, decay, 0
        self.parameters = list(network.parameters())
        self.mean = [torch.zeros_like(p) for p in self.parameters]
        self.square = [torch.zeros_like(p) for p in self.parameters]

    def step(self, loss: Tensor) -> None:
        gradients = torch.autograd.grad(loss, self.parameters)
        self.steps += 1
        rate = self.rate * math.sqrt(1 - 0.999**self.steps) / (1 - 0.9**self.steps)
        with torch.no_grad():
            for p, g, mean, square in zip(self.parameters, gradients, self.mean, self.square, strict=True):
                mean.lerp_(g, 0.1)
                square.mul_(0.999).addcmul_(g, g, value=0.001)
                if p.dim() == 2:
                    p.mul_(1 - self.rate * self.decay)
                p.addcdiv_(mean, square.sqrt().add_(1e-8), value=-rate)


def masked(train: Rows, valid: Rows, *, seed: int, masks: int, hidden: int, rate: float, decay: float) -> Fitted:
    """Adam with decoupled weight decay, mini-batches of 100; the best weights on the validation rows are kept."""
    generator = torch.Generator().manual_seed(seed)
    network = MaskedNetwork(smoothed_means(train, 1.0), hidden, masks, generator)
    optimiser = Adam(network, rate, decay)
    x = torch.from_numpy(train).float()
    best, best_valid, waited, updates, last = copy.deepcopy(network.state_dict()), -math.inf, 0, 0, 0
    while updates < _UPDATES and waited < _PATIENCE:
        for part in torch.randperm(len(x), generator=generator).split(_BATCH):
            optimiser.step(-network.of_mask(x[part], network.masks[updates % masks]).mean())
            updates += 1
        if updates - last < _UPDATES_AT_LEAST_BETWEEN:
            continue
        last = updates
        reached = float(network.log_likelihood(valid).mean())
        waited += 1
        if reached > best_valid:
            best, best_valid, waited = copy.deepcopy(network.state_dict()), reached, 0
    network.load_state_dict(best)
    note = f"ended by its {_UPDATES} updates, not by the validation rows" if waited < _PATIENCE else ""
    return Fitted(network.log_likelihood, note)
