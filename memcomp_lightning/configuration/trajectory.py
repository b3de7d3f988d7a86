"""The paper's Fig. 2: the path of the machine on an RBM that it trains."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from memcomp_lightning.configuration.composition import composed_for
from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.plans import build
from memcomp_lightning.errors import SettingError, require
from memcomp_lightning.models import DBN
from memcomp_lightning.solvers.dmm import DmmSolver, Recording
from memcomp_lightning.studies.plan import Plan
from memcomp_lightning.studies.trajectory import draw_trajectory


def check(config: DictConfig, overrides: Sequence[str]) -> tuple[Plan, DmmSolver]:
    """Build the network and the machine; refuses another solver than the DMM, and a run without pretraining."""
    composed = composed_for(overrides)
    plan, solver = build(composed), instantiate(composed.solver)
    if not isinstance(plan.network, DBN) or plan.pretraining is None:
        raise SettingError(f"{config.figure.name} needs pretraining: model=dbn and pretrain.iterations >= 1.")
    require(isinstance(solver, DmmSolver), "solver", type(solver).__name__, "the DMM (solver=dmm)")
    return plan, replace(solver, record=Recording(every=1))


def train(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Pretrain a DBN, let the machine solve its first RBM once more, and draw its path."""
    draw_trajectory(*check(config, overrides), seed=config.seed, folder=folder)
