"""Statistical checks of samplers against enumeration."""

import torch
from scipy import stats
from torch import Tensor

from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.models import RBM


def state_counts(x: Tensor) -> Tensor:
    """Count how often each binary state occurs among rows.

    Args:
        x: ``(n_samples, n)`` in {0, 1}, n <= 20.

    Returns:
        ``(2^n,)`` int64; the first unit is the highest bit.
    """
    n = x.shape[-1]
    powers = 2 ** torch.arange(n - 1, -1, -1, device=x.device)
    return torch.bincount((x.long() * powers).sum(-1), minlength=2**n)


@torch.no_grad()
def visible_probabilities(model: RBM) -> Tensor:
    """p(v) of every visible state of an RBM by enumeration, in the order of :func:`state_counts`.

    Args:
        model: With at most 20 visible units.

    Returns:
        ``(*replicas, 2^n_visible)`` float64.
    """
    states = binary_states(model.n_visible, like=model.b).expand(*model.replicas, -1, -1)
    return torch.softmax(-model.free_energy(states).double(), dim=-1)


def chi_square_p_value(counts: Tensor, probabilities: Tensor, *, min_expected: float = 5.0) -> float:
    """Return the p value of Pearson's test of counts against probabilities; rare states are pooled.

    With 20,000 independent samples of a few units it sees a temperature wrong by 5 % in most runs; with
    1,000 it does not.

    Args:
        counts: ``(n_states,)``.
        probabilities: ``(n_states,)``, adding up to one.
        min_expected: States expected less often than this are counted as one.
    """
    expected = probabilities.detach().double() * counts.sum()
    if bool((counts[expected == 0] > 0).any()):
        return 0.0  # A state that cannot occur did.
    rare = expected < min_expected
    observed_bins, expected_bins = counts[~rare].double(), expected[~rare]
    if bool(rare.any()) and float(expected[rare].sum()) > 0:
        observed_bins = torch.cat((observed_bins, counts[rare].sum().double().reshape(1)))
        expected_bins = torch.cat((expected_bins, expected[rare].sum().reshape(1)))
    if len(expected_bins) < 2:
        return 1.0
    expected_bins = expected_bins * observed_bins.sum() / expected_bins.sum()
    return float(stats.chisquare(observed_bins.numpy(), expected_bins.numpy()).pvalue)
