"""The energy models that a network consists of."""

from torch import nn

from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.boltzmann import BoltzmannMachine
from memcomp_lightning.models.dbm import DBM
from memcomp_lightning.models.dbn import DBN
from memcomp_lightning.models.rbm import RBM


def energy_models(network: nn.Module) -> list[EnergyModel]:
    """The RBMs of a DBN, from the data upwards; an energy model itself; none of a feed-forward network."""
    if isinstance(network, DBN):
        return list(network)
    return [network] if isinstance(network, RBM | BoltzmannMachine) else []


def joint_model(network: nn.Module) -> EnergyModel:
    """One energy model of all units: of a DBN its only RBM, or the DBM of its layers; an energy model itself.

    Raises:
        TypeError: A feed-forward network has none.
    """
    models = energy_models(network)
    if not models:
        raise TypeError(f"{type(network).__name__} has no energy")
    return DBM.from_dbn(network) if isinstance(network, DBN) and len(models) > 1 else models[0]
