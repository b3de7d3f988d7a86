"""What the training of a model leaves to one that goes on from it: chains and centres, as plain tensors."""

from typing import Any

from torch import Generator, Tensor

from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.objective import Offsets
from memcomp_lightning.samplers.base import tensors_of, with_tensors
from memcomp_lightning.training.step import EnergyStep, StepState


def kept_of(state: StepState, step: EnergyStep) -> dict[str, Any]:
    """The state of a training, for a file: name of the sampler, its tensors, and the centres."""
    return {
        "kind": type(step.sampler).__name__,
        "sampler": None if state.sampler is None else tensors_of(state.sampler),
        "offsets": None if state.offsets is None else state.offsets._asdict(),
    }


def state_of(
    kept: dict[str, Any], step: EnergyStep, model: EnergyModel, n: int, *, generator: Generator
) -> tuple[StepState, str]:
    """The state in which a training begins that goes on from another, and what became of the chains, in words.

    Chains are kept if the sampler is of the same kind and would make as many of the same shapes; its counts begin
    anew, as schedules do. Centres are kept where both trainings have them.

    Args:
        kept: From :func:`kept_of`.
        step: Of the training that begins.
        model: Its model.
        n: Configurations of its first positive phase.
        generator: For the chains that a sampler would begin with, which are not used.
    """
    like, offsets = model.b, None
    if step.centring is not None and kept["offsets"] is not None:
        offsets = Offsets(**{name: x.to(like) for name, x in kept["offsets"].items()})
    now = type(step.sampler).__name__
    if kept["kind"] != now:
        return StepState(offsets=offsets), f"begin anew, because they were of {kept['kind']} and are of {now}"
    template = step.sampler.init(model, n, generator=generator)
    own, found = tensors_of(template), kept["sampler"] or {}
    if not own:
        return StepState(offsets=offsets), f"are none: {now} remembers nothing"
    if {name: x.shape for name, x in own.items()} != {name: x.shape for name, x in found.items()}:
        return StepState(offsets=offsets), f"begin anew, because {now} has others now, or another number of them"
    taken = {name: x if _counts(x) else found[name].to(x) for name, x in own.items()}
    return StepState(with_tensors(template, taken), offsets), "are kept"


def _counts(x: Tensor) -> bool:
    return x.ndim == 0 and not x.is_floating_point()
