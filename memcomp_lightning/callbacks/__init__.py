"""Callbacks that log, draw or guard training; :mod:`memcomp_lightning.callbacks.base` says what they need."""

from memcomp_lightning.callbacks.best_likelihood import BestLikelihood
from memcomp_lightning.callbacks.best_weights import BestWeights
from memcomp_lightning.callbacks.chain_pictures import ChainPictures
from memcomp_lightning.callbacks.classification import ClassificationMetrics
from memcomp_lightning.callbacks.densities import Densities
from memcomp_lightning.callbacks.energy_histograms import EnergyHistograms
from memcomp_lightning.callbacks.free_energy_gap import FreeEnergyGap
from memcomp_lightning.callbacks.free_energy_histograms import FreeEnergyHistograms
from memcomp_lightning.callbacks.gradient_bias import GradientBias
from memcomp_lightning.callbacks.histograms import ParameterHistograms
from memcomp_lightning.callbacks.hyper_parameters import HyperParameters
from memcomp_lightning.callbacks.log_likelihood import LogLikelihood
from memcomp_lightning.callbacks.logos import Logos
from memcomp_lightning.callbacks.model_samples import ModelSamples
from memcomp_lightning.callbacks.negative_phase import NegativePhaseEnergies
from memcomp_lightning.callbacks.optimizer_monitor import OptimizerMonitor
from memcomp_lightning.callbacks.progress import StageProgressBar
from memcomp_lightning.callbacks.receptive_fields import ReceptiveFields
from memcomp_lightning.callbacks.reconstruction_error import ReconstructionError
from memcomp_lightning.callbacks.sampler_diagnostics import SamplerDiagnostics
from memcomp_lightning.callbacks.samples_against_data import SamplesAgainstData
from memcomp_lightning.callbacks.saturation_guard import SaturationGuard
from memcomp_lightning.callbacks.schedules import Schedules
from memcomp_lightning.callbacks.stage_times import StageTimes
from memcomp_lightning.callbacks.state_frequencies import StateFrequencies
from memcomp_lightning.callbacks.state_weights import StateWeights
from memcomp_lightning.callbacks.still_falling import StillFalling
from memcomp_lightning.callbacks.trajectory_figure import TrajectoryFigure

__all__ = [
    "BestLikelihood",
    "BestWeights",
    "ChainPictures",
    "ClassificationMetrics",
    "Densities",
    "EnergyHistograms",
    "FreeEnergyGap",
    "FreeEnergyHistograms",
    "GradientBias",
    "HyperParameters",
    "LogLikelihood",
    "Logos",
    "ModelSamples",
    "NegativePhaseEnergies",
    "OptimizerMonitor",
    "ParameterHistograms",
    "ReceptiveFields",
    "ReconstructionError",
    "SamplerDiagnostics",
    "SamplesAgainstData",
    "SaturationGuard",
    "Schedules",
    "StageProgressBar",
    "StageTimes",
    "StateFrequencies",
    "StateWeights",
    "StillFalling",
    "TrajectoryFigure",
]
