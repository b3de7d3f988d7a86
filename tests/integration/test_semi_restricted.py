"""A semi-restricted machine from the command line: trained, scored, and annealed by the callback."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from running import QUIET, Outcome

import memcomp_lightning
from memcomp_lightning.callbacks import LogLikelihood, log_likelihood
from memcomp_lightning.models import BoltzmannMachine, energy_models
from memcomp_lightning.models.connectivity import semi_restricted

QUICK = [*QUIET, "pretrain.iterations=2", "model.n_hidden=20"]
N_COLUMNS = 18


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("semi_restricted")
    rows = np.random.default_rng(0).random((120, 3)) < 0.4
    np.save(folder / "rows.npy", rows.repeat(N_COLUMNS // 3, axis=1).astype(np.uint8))
    return folder


def run(run_command: Callable[..., Outcome], name: str, *arguments: str) -> Outcome:
    return run_command(f"memcomp-{name}", import_module(f"memcomp_lightning.cli.{name}").main, arguments)


@pytest.mark.parametrize("sampler", ["pcd", "cd"])
def test_a_table_is_learned_and_scored(
    runs: Path, sampler: str, run_command: Callable[..., Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(runs)
    own = ["data=arrays", "data.path=rows.npy", "model=semi_restricted", f"sampler={sampler}"]
    trained = run(run_command, "train", *own, *QUICK, "pretrain=boltzmann", f"hydra.run.dir={sampler}")
    assert trained.status == 0, trained.err
    (model,) = energy_models(memcomp_lightning.load(runs / sampler).network)
    assert isinstance(model, BoltzmannMachine)
    assert model.pairs.equal(semi_restricted(N_COLUMNS, 20))
    if sampler == "pcd":  # exact here: 20 hidden units are summed, 18 visible ones enumerated
        scored = run(run_command, "score", "pcd", "rows.npy", "output=scores.csv")
        assert scored.status == 0, scored.err
        assert ", exact" in scored.out
        assert "lower bound" not in scored.out + scored.err


def test_the_callback_anneals_machines_that_take_about_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    quick, slow = LogLikelihood(), LogLikelihood(n_betas=100_000)
    machine = BoltzmannMachine(20, 5, semi_restricted(20, 5))
    assert quick._method_for(machine) == "ais"
    assert slow._method_for(machine) is None
    assert quick._method_for(BoltzmannMachine(12, 5, semi_restricted(12, 5))) == "exact"
    monkeypatch.setattr(log_likelihood, "QUICKLY_ANNEALED", 1)
    assert quick._method_for(machine) is None
