"""What a sampler of the negative phase must offer, and helpers for its state."""

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, TypeVar

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_parts
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.types import Configurations, NegativePhase

ModelT = TypeVar("ModelT", contravariant=True)
StateT = TypeVar("StateT")


def tensors_of(state: Any) -> dict[str, Tensor]:
    """The tensors of a sampler's state by dotted names; states may hold states.

    >>> from memcomp_lightning.types import NoState
    >>> tensors_of(NoState())
    {}
    """
    require_state(state)
    found: dict[str, Tensor] = {}
    for name, value in state._asdict().items():
        if isinstance(value, Tensor):
            found[name] = value
        else:
            found |= {f"{name}.{inner}": tensor for inner, tensor in tensors_of(value).items()}
    return found


def with_tensors(state: StateT, tensors: Mapping[str, Tensor]) -> StateT:
    """Inverse of :func:`tensors_of`: a state like ``state`` that holds these tensors."""
    values: dict[str, Any] = {}
    for name, value in state._asdict().items():  # type: ignore[attr-defined]
        if isinstance(value, Tensor):
            values[name] = tensors[name]
        else:
            inner = {key.removeprefix(f"{name}."): t for key, t in tensors.items() if key.startswith(f"{name}.")}
            values[name] = with_tensors(value, inner)
    return type(state)(**values)


@torch.no_grad()
def positive_phase(model: EnergyModel, v: Tensor) -> Configurations:
    """Return data with the hidden means given them, ``E[h | v]``."""
    return Configurations(v, model.hidden_mean(v))


def holds_chains(state: object, widths: tuple[int, ...]) -> bool:
    """Whether a sampler's state, or one in it, holds states of so many units, which go on from there."""
    if isinstance(state, Tensor):
        return state.ndim >= 2 and state.shape[-1] in widths
    return isinstance(state, tuple) and any(holds_chains(part, widths) for part in state)


def require_sampler(name: str, sampler: object) -> None:
    """Raise unless an object has what :class:`NegativePhaseSampler` asks for."""
    require_parts(name, sampler, "sampler of the negative phase", ("init", "sample", "uses_data", "shared"))


def require_state(state: object) -> None:
    """Raise unless a sampler's state can be kept in a checkpoint."""
    kept = isinstance(state, tuple) and hasattr(state, "_asdict")
    allowed = "a NamedTuple of tensors, or NoState()"
    require(kept, "state of the sampler", type(state).__name__, allowed, "Checkpoints keep it by names.")


class NegativePhaseSampler(Protocol[ModelT, StateT]):
    """Supplies the states whose mean energy stands for the expectation under the model.

    One object serves every layer and replica: settings are frozen, what a call must remember is the state.

    Attributes:
        uses_data: The negative phase depends on the positive one (contrastive divergence starts there). If not,
            one call serves an update however many chunks its images come in.
        shared: The answer depends on the model alone, so with several processes one of them computes it for
            all. Otherwise every process draws its own.

    A sampler whose configurations may have negative weights says ``signed_weights = True`` as well: the gradient
    of their mean energy is right, and no configuration is a draw from a distribution.
    """

    uses_data: ClassVar[bool]
    shared: ClassVar[bool]

    def init(self, model: ModelT, n_chains: int, *, generator: Generator) -> StateT:
        """Return the state before the first call.

        Args:
            model: The energy model.
            n_chains: Number of chains a replica, unless the sampler has a number of its own.
            generator: Random stream of the negative phase.
        """

    def sample(
        self, model: ModelT, state: StateT, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[StateT]:
        """Return the negative phase of one update.

        Args:
            model: The energy model; not changed.
            state: What :meth:`init` or the previous call returned; not changed.
            positive: The positive phase: ``v`` is data, ``(*replicas, n, n_visible)`` in [0, 1], ``h`` the
                hidden means given it.
            generator: Random stream of the negative phase.
        """
