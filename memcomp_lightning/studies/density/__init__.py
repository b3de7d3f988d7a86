"""Density models of tables: energy models with any negative phase, and peers, by the likelihood of test rows."""

from memcomp_lightning.studies.density.peers import Peer, PeerTrial, peers_of
from memcomp_lightning.studies.density.results import Densities, read_densities
from memcomp_lightning.studies.density.settings import Density, Model
from memcomp_lightning.studies.density.trial import DensityTrial

__all__ = ["Densities", "Density", "DensityTrial", "Model", "Peer", "PeerTrial", "peers_of", "read_densities"]
