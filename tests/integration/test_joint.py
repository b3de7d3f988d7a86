"""Boltzmann machines and DBMs under a Lightning trainer and from the command line."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from running import Outcome
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from memcomp_lightning.callbacks import GradientBias, LogLikelihood
from memcomp_lightning.data import BarsAndStripes, ImageDataModule, ShiftingBars
from memcomp_lightning.interop import annealer_graph
from memcomp_lightning.likelihood import kl_divergence, log_likelihood, log_partition_function
from memcomp_lightning.models import DBM, DBN, RBM, BoltzmannMachine, Normal
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import (
    PCD,
    ClampedGibbs,
    Exact,
    ExactPosterior,
    GroundState,
    ModeAssisted,
    ModeSchedule,
)
from memcomp_lightning.solvers import BruteForce
from memcomp_lightning.studies import Records
from memcomp_lightning.studies.likelihood import weights_path
from memcomp_lightning.training import Boltzmann, Joint

Run = Callable[..., Outcome]


def bars(**settings: Any) -> ImageDataModule:
    return ImageDataModule(BarsAndStripes().load(), batch_size=None, **settings)


def fit(module: pl.LightningModule, callbacks: list[pl.Callback], **settings: Any) -> pl.Trainer:
    trainer = pl.Trainer(
        max_epochs=module.n_epochs,
        accelerator="cpu",
        logger=False,
        callbacks=callbacks,
        enable_checkpointing=any(isinstance(c, ModelCheckpoint) for c in callbacks),
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(module, datamodule=bars(), **settings)
    return trainer


@pytest.mark.parametrize("centring", [None, Centring(rate=0.1)], ids=["plain", "centred"])
@pytest.mark.parametrize("kind", ["DBM", "full"])
def test_exact_phases_learn_the_data(kind: str, centring: Centring | None) -> None:
    """Bars and stripes, from the uniform distribution (3.6 nats) to close to the data."""
    settings: dict[str, Any] = {"weight_init": Normal(std=0.1)}
    model = DBM(9, [5, 3], **settings) if kind == "DBM" else BoltzmannMachine(9, 4, **settings)
    module = EnergyPretraining(
        Boltzmann(model, positive=ExactPosterior()),
        Exact(),
        iterations={"DBM": 400, "full": 150}[kind],
        optimizer=partial(torch.optim.SGD, lr={"DBM": 1.0, "full": 0.5}[kind], momentum=0.5),
        centring=centring,
    )
    v = bars().images.train_v
    before = float(kl_divergence(model, v))
    fit(module, [])
    assert (before > 2.5, float(kl_divergence(model, v)) < 0.9) == (True, True)


def test_a_dbn_takes_the_weights_of_its_dbm() -> None:
    dbn = DBN(9, [5, 3])
    module = EnergyPretraining(Joint(dbn), PCD(n_chains=11), iterations=3)
    start = [rbm.weight.clone() for rbm in dbn]
    fit(module, [])
    for rbm, weight, old in zip(dbn, module.model.weights(), start, strict=True):
        torch.testing.assert_close(rbm.weight, weight)
        assert not rbm.weight.equal(old)
    again = EnergyPretraining(Joint(dbn), PCD(n_chains=11)).model
    torch.testing.assert_close(again.state_dict(), module.model.state_dict())


MODE = ModeAssisted(
    inner=PCD(n_chains=7), mode=GroundState(solver=BruteForce()), schedule=ModeSchedule(n_updates=3, p_max=1.0)
)


@pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`")
@pytest.mark.parametrize("sampler", [PCD(n_chains=7), MODE], ids=["PCD", "mode-assisted PCD"])
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path: Path, sampler: Any) -> None:
    def module(iterations: int) -> EnergyPretraining:
        return EnergyPretraining(Joint(DBN(9, [5, 3]), positive=ClampedGibbs(k=2)), sampler, iterations=iterations)

    whole, half, rest = module(6), module(6), module(6)
    fit(whole, [])

    half.iterations = 3
    keep = ModelCheckpoint(dirpath=tmp_path, filename="half", every_n_epochs=3, save_on_train_epoch_end=True)
    fit(half, [keep])
    fit(rest, [], ckpt_path=tmp_path / "half.ckpt", weights_only=True)
    for name, tensor in whole.state_dict().items():
        assert tensor.equal(rest.state_dict()[name]), name


def test_callbacks_look_at_boltzmann_machines(tmp_path: Path) -> None:
    found = {}
    for callbacks in ([], [GradientBias(), LogLikelihood(every=1, method="exact", max_units=9)]):
        module = EnergyPretraining(Joint(DBN(9, [5, 3]), positive=ExactPosterior()), Exact(), iterations=2)
        trainer = fit(module, list(callbacks))
        found[len(callbacks)] = module.model.state_dict()
    metrics = trainer.callback_metrics
    assert float(metrics["pretrain/joint/gradient_bias/relative_error"]) < 1e-4
    v = bars().images.train_v
    expected = log_likelihood(module.model, v, log_partition_function(module.model)).mean()
    assert float(metrics["pretrain/joint/log_likelihood_train"]) == pytest.approx(float(expected), rel=1e-5)
    torch.testing.assert_close(found[0], found[2], rtol=0, atol=0)


def test_joint_and_greedy_from_the_command_line(memcomp_train: Run) -> None:
    short = ["data=digits", "sampler=pcd", "pretrain.iterations=2", "finetune.iterations=1", "seed=3"]
    weights = {}
    for pretrain in ("greedy", "joint"):
        outcome = memcomp_train(*short, f"pretrain={pretrain}", f"hydra.run.dir={pretrain}")
        assert outcome.status == 0, outcome.err
        weights[pretrain] = torch.load(f"{pretrain}/weights/pretrain.pt", weights_only=True)
        result = json.loads(Path(pretrain, "result.json").read_text())
        assert len(result["stages"]["pretrain"]["energy_gap"]) == (2 if pretrain == "greedy" else 1)
    assert "pretrain jointly" in outcome.out
    assert weights["greedy"].keys() == weights["joint"].keys()
    assert not weights["greedy"]["rbms.1.weight"].equal(weights["joint"]["rbms.1.weight"])
    (events,) = {path.parent for path in Path("joint").rglob("events.out*")}
    tags = EventAccumulator(str(events)).Reload().Tags()
    assert "pretrain/joint/negative_phase/mean_field_converged" in tags["scalars"]
    for name in ("receptive_fields", "samples", "chains"):
        assert f"pretrain/joint/{name}" in tags["images"]

    start = memcomp_train(
        *short, "pretrain=joint", "model.weights=greedy/weights/pretrain.pt", "hydra.run.dir=from_greedy"
    )
    assert start.status == 0, start.err


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("positive.max_iterations=0", "max_iterations = 0"),
        ("positive.tolerance=-1", "tolerance = -1"),
        ("+pretrain.stage.posterior=1", "posterior"),
        ("sampler.n_chains=0", "n_chains = 0"),
        ("sampler=exact", "units to enumerate = 32"),
    ],
)
def test_wrong_settings_are_refused_before_training(memcomp_train: Run, override: str, message: str) -> None:
    outcome = memcomp_train("data=digits", "sampler=pcd", "pretrain=joint", override, "hydra.run.dir=run")
    assert outcome.status != 0
    assert message in outcome.err
    assert not Path("run").exists()


def test_a_machine_on_the_graph_of_an_annealer_is_trained_and_resumed(memcomp_train: Run) -> None:
    small = [
        "model.connectivity.size=1",
        "pretrain.iterations=2",
        "solver.n_restarts=3",
        "sampler.schedule.delay=-9",
    ]
    outcome = memcomp_train("experiment=annealer_graph", "data=digits", *small, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    result = json.loads(Path("run/result.json").read_text())
    assert result["stages"]["pretrain"]["trained"] == ["jointly"]
    weights = torch.load("run/weights/pretrain.pt", weights_only=True)
    model = BoltzmannMachine(32, None, annealer_graph("zephyr", 1, n_visible=32))
    model.load_state_dict(weights)
    assert model.n_units == 48
    assert memcomp_train("resume=run").status == 0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["model=boltzmann", "pretrain=boltzmann"], "0 for a Boltzmann machine"),
        (
            ["model=boltzmann", "finetune.iterations=0"],
            "For a Boltzmann machine use pretrain=boltzmann",
        ),
        (["pretrain=boltzmann"], "For a DBN use pretrain=greedy, centred or joint"),
        (
            ["model=zephyr", "pretrain=boltzmann", "finetune.iterations=0", "model.connectivity.kind=zefyr"],
            "kind = 'zefyr'",
        ),
    ],
)
def test_models_and_pretraining_that_do_not_fit_are_refused(
    memcomp_train: Run, overrides: list[str], message: str
) -> None:
    outcome = memcomp_train("data=digits", "sampler=pcd", *overrides, "hydra.run.dir=run")
    assert outcome.status != 0
    assert message in outcome.err


def test_joint_against_greedy_pretraining_is_a_figure(memcomp_train: Run) -> None:
    small = [
        "data=digits",
        "data.partitions=2",
        "figure.iterations=[2]",
        "figure.controls_at=[2]",
        "figure.passes=[1]",
    ]
    outcome = memcomp_train("experiment=joint", *small, "figure.workers=1", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert "joint, PCD-1 with mean field is above greedy, PCD-1" in outcome.out
    assert Path("run/joint_controls.png").stat().st_size > 0


def test_deep_and_full_machines_are_compared_by_their_likelihood(memcomp_train: Run) -> None:
    """Layer by layer, from a greedy start, all pairs coupled: as many passes each; models are loaded again."""
    methods = ["rbm_pcd", "greedy_pcd", "joint_pcd_greedy_start", "full_mode_dmm"]
    outcome = memcomp_train(
        "experiment=joint_likelihood",
        "worth.only=[shifting_bars]",
        f"+worth.data_sets.shifting_bars.methods=[{','.join(methods)}]",
        "worth.data_sets.shifting_bars.passes=20",
        *["worth.rates=[0.5]", "worth.replicas=2", "worth.choosing=1", "worth.points=3", "worth.workers=1"],
        "worth.claimed=[joint_pcd_greedy_start]",
        "hydra.run.dir=run",
    )
    assert outcome.status == 0, outcome.err
    v = ShiftingBars().load().train_v
    models: dict[str, Any] = {
        "rbm_pcd": RBM(9, 10, replicas=(3,)),
        "greedy_pcd": DBM(9, [6, 6], replicas=(3,)),
        "joint_pcd_greedy_start": DBM(9, [6, 6], replicas=(3,)),
        "full_mode_dmm": BoltzmannMachine(9, 5, replicas=(3,)),
    }
    found = Records(Path("run")).all
    assert [record.method for record in found] == methods
    for record in found:
        assert record.at[-1] == 20
        model = models[record.method]
        model.load_state_dict(torch.load(weights_path(Path("run"), record), weights_only=True))
        assert record.measures["score"][-1] == pytest.approx(kl_divergence(model, v).tolist(), rel=1e-5)
