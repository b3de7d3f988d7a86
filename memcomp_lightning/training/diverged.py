"""Notice training that has diverged: parameters that are infinite, NaN or huge."""

from torch import nn

LARGEST_WEIGHT = 1e15
"""A parameter beyond this, or not finite, means that training diverged."""


class DivergedError(ValueError):
    """Training left the finite numbers; which tensor, where, and what to do."""


def diverged_parameter(module: nn.Module, largest_allowed: float = LARGEST_WEIGHT) -> str | None:
    """Say which parameter left the allowed numbers, and how far; None if none did."""
    for name, parameter in module.named_parameters():
        if not parameter.numel():  # biases of no hidden units
            continue
        largest = float(parameter.detach().abs().max())
        if not largest <= largest_allowed:
            return f"{name} has an entry of {largest:g}"
    return None


def require_finite(module: nn.Module, where: str) -> None:
    """Raise a DivergedError if a parameter left the finite numbers, and name it."""
    if (diverged := diverged_parameter(module)) is not None:
        raise DivergedError(f"{where}: {diverged}. Lower the learning rate.")
