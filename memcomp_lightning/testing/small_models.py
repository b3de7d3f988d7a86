"""Small models of units of all kinds, for the kits of samplers and solvers and for tests of one's own."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from memcomp_lightning import rng
from memcomp_lightning.models import DBM, DBN, RBM, BoltzmannMachine, Normal
from memcomp_lightning.models.connectivity import full
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, ReLU, Spin, Units

Makers = dict[str, Callable[..., Any]]
"""Functions that take ``replicas`` and return a model, by what the model is made of."""


def small_layers() -> dict[str, Units]:
    """Visible layers of three to six entries, one of each kind."""
    variance = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float32, device="cpu")
    return {
        "bits": Bernoulli(4),
        "spins": Spin(4),
        "categories": Categorical(2, q=3),
        "ragged categories": Categorical([2, 4]),
        "real": Gaussian(3, variance=variance),
        "real of fixed variance": Gaussian(3, variance=variance, learned=False),
        "mixed": Mixed(
            Bernoulli(1), Categorical([3]), Gaussian(1, variance=0.7), Spin(1), Gaussian(1, learned=False)
        ),
        "mixed without real ones": Mixed(Spin(2), Categorical([3])),
    }


def small_rbms() -> Makers:
    """RBMs of each visible kind with hidden bits, spins, categories and, where they may be, ReLU units.

    >>> small_rbms()["spins x bits"](replicas=(2,)).weight.shape
    torch.Size([2, 3, 4])
    """
    hidden: dict[str, Units] = {
        "bits": Bernoulli(3),
        "spins": Spin(3),
        "categories": Categorical([3, 2]),
        "ReLU": ReLU(2),
    }
    found: Makers = {
        f"{name} x {other}": partial(_rbm, visible, units)
        for name, visible in small_layers().items()
        for other, units in hidden.items()
        if not (visible.real and units.real)
    }
    return found | {
        "spins below more spins": partial(_rbm, Spin(3), Spin(5)),
        "categories below more bits": partial(_rbm, Categorical([2, 3]), Bernoulli(4)),
        "bits x real": partial(_rbm, Bernoulli(4), Gaussian(2, variance=0.8, learned=False)),
    }


def small_machines() -> Makers:
    """Boltzmann machines and DBMs of visible units of several kinds, with and without hidden units."""
    layers = small_layers()
    among_discrete = [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (0, 4), (3, 4), (1, 5), (2, 5), (5, 6), (3, 6)]
    return {
        "spins, all pairs": partial(_machine, Spin(4), Spin(3), None),
        "spins alone": partial(_machine, Spin(5), Spin(0), None),
        "categories, all pairs": partial(_machine, Categorical([2, 3]), Bernoulli(3), full(5)[1:]),
        "categories alone": partial(_machine, Categorical([2, 3, 4]), Bernoulli(0), None),
        # Sites 2 and 4 are real and coupled to the others alone; 5 and 6 are hidden.
        "mixed": partial(_machine, layers["mixed"], Spin(2), among_discrete),
        "mixed alone": partial(_machine, layers["mixed"], Spin(0), [(0, 2), (0, 1), (1, 4), (2, 3), (3, 4)]),
        "real, hidden coupled": partial(
            _machine, Gaussian(2), Bernoulli(3), [(0, 2), (0, 3), (1, 4), (2, 3), (3, 4)]
        ),
        "DBM of spins": partial(_dbm, Spin(4)),
        "DBM of categories": partial(_dbm, Categorical([2, 3])),
        "DBM of real units": partial(_dbm, Gaussian(3, variance=0.6)),
        "DBM of mixed units": partial(_dbm, layers["mixed"]),
    }


def small_dbn(visible: Units, *, replicas: tuple[int, ...] = ()) -> DBN:
    """A DBN with such a first layer and layers of 3 and 2 bits."""
    generator = rng.stream(0, "test model")
    dbn = DBN(None, [3, 2], visible=visible, replicas=replicas, weight_init=Normal(std=0.6), generator=generator)
    for rbm in dbn:
        _drawn(rbm, generator)
    return dbn


def _rbm(visible: Units, hidden: Units, *, replicas: tuple[int, ...] = (), std: float = 0.6) -> Any:
    generator = rng.stream(0, "test model")
    init = Normal(std=std)
    rbm = RBM(visible=visible, hidden=hidden, replicas=replicas, weight_init=init, generator=generator)
    return _drawn(rbm, generator)


def _machine(visible: Units, hidden: Units, connectivity: Any, *, replicas: tuple[int, ...] = ()) -> Any:
    generator = rng.stream(0, "test model")
    machine = BoltzmannMachine(
        visible=visible,
        hidden=hidden,
        connectivity=connectivity,
        replicas=replicas,
        weight_init=Normal(std=0.6),
        generator=generator,
    )
    return _drawn(machine, generator)


def _dbm(visible: Units, *, replicas: tuple[int, ...] = ()) -> Any:
    generator, init = rng.stream(0, "test model"), Normal(std=0.6)
    return _drawn(
        DBM(None, [3, 2], visible=visible, replicas=replicas, weight_init=init, generator=generator), generator
    )


@torch.no_grad()
def _drawn(model: Any, generator: torch.Generator) -> Any:
    """The model with biases, and with precisions that differ between replicas."""
    model.b.normal_(0.3, 0.5, generator=generator)
    model.c.normal_(-0.2, 0.5, generator=generator)
    for name, tensor in model.state_dict().items():
        if name.endswith(".precision"):
            tensor.mul_(torch.empty_like(tensor).uniform_(0.7, 1.4, generator=generator))
    return model
