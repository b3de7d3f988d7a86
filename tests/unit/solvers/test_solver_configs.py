"""The solver's configs say the same as the classes that they build."""

import dataclasses
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from memcomp_lightning.solvers.dmm import BondField, ClauseField, DmmSolver

SOLVER = Path(__file__).parents[3] / "conf" / "solver"


@pytest.mark.parametrize(
    ("path", "kind", "absent"),
    [
        ("field/clause.yaml", ClauseField, {"integrator"}),
        ("field/bond.yaml", BondField, {"integrator"}),
        ("dmm.yaml", DmmSolver, {"field"}),
    ],
)
def test_configs_list_every_setting_with_its_default(path, kind, absent):
    config = OmegaConf.to_container(OmegaConf.load(SOLVER / path))
    assert config.pop("_target_") == f"memcomp_lightning.solvers.dmm.{kind.__name__}"
    config.pop("defaults", None)
    defaults = {field.name: field.default for field in dataclasses.fields(kind) if field.name not in absent}
    assert config == defaults
