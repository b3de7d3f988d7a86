"""``experiment=sampler_worth`` in small: records, resume, report, TensorBoard."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from running import Outcome
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from memcomp_lightning import rng
from memcomp_lightning.callbacks.gradient_bias import gradient
from memcomp_lightning.data import Digits, ImageDataModule, ShiftingBars
from memcomp_lightning.likelihood import kl_divergence, log_likelihood, log_partition_function
from memcomp_lightning.models import DBN, RBM, Normal
from memcomp_lightning.samplers import Exact, GroundState, ModeAssisted, ModeSchedule, positive_phase
from memcomp_lightning.solvers import BruteForce
from memcomp_lightning.studies import Record, Records
from memcomp_lightning.studies.likelihood import weights_path
from memcomp_lightning.studies.measures.gradient_bias import mean_gradient
from memcomp_lightning.studies.worth import read_worth

Run = Callable[..., Outcome]
KEPT = ("cd1", "cd1_long", "exact", "mode_cd_exact")
SMALL = [
    "experiment=sampler_worth",
    "worth.only=[shifting_bars]",
    f"+worth.data_sets.shifting_bars.methods=[{','.join(KEPT)}]",
    "worth.data_sets.shifting_bars.passes=40",
    "worth.claimed=[mode_cd_exact]",
    "worth.baselines=[cd1,cd1_long]",
    "worth.rates=[0.1,0.5]",
    *[f"worth.methods.{name}.rates=[0.1,0.5]" for name in ("cd1", "cd1_long", "exact")],
    "worth.methods.exact.longer=1",
    "worth.replicas=3",
    "worth.choosing=2",
    "worth.points=4",
    "worth.workers=1",
    "hydra.run.dir=run",
]


def records() -> list[Record]:
    return Records(Path("run")).all


def test_a_sampler_of_ones_own_is_a_method(memcomp_train: Run, tmp_path: Path) -> None:
    (tmp_path / "confs/sampler").mkdir(parents=True)
    (tmp_path / "confs/sampler/mine.yaml").write_text("_target_: memcomp_lightning.samplers.CD\nk: 3\n")
    own = "+worth.methods.mine={label: mine, overrides: ['sampler=mine'], rates: [0.5]}"
    settings = [o for o in SMALL if not o.startswith(("worth.claimed", "+worth"))]
    methods = ["+worth.data_sets.shifting_bars.methods=[cd1,mine]", "worth.claimed=[mine]"]
    outcome = memcomp_train("--config-dir=confs", *settings, own, *methods)
    assert outcome.status == 0, outcome.err
    assert "mine beats CD-1" in outcome.out
    assert {record.method for record in records()} == {"cd1", "mine"}


def test_methods_are_trained_measured_resumed_and_reported(memcomp_train: Run) -> None:
    outcome = memcomp_train(*SMALL)
    assert outcome.status == 0, outcome.err
    assert "mode-assisted CD-1, exact mode beats" in outcome.out
    found = records()
    tried = {("shifting_bars", method, rate) for method in KEPT for rate in (0.1, 0.5)}
    assert {(record.data_set, record.method, record.value) for record in found} == tried
    for record in found:
        n_passes = 120 if record.method == "cd1_long" else 40
        assert (record.at[0], record.at[-1], len(record.at)) == (1, n_passes, 4)
        assert all(len(scores) == 5 for scores in record.measures["score"])
        assert record.seconds == sorted(record.seconds)
        assert record.held_out == -sum(record.measures["score"][-1][3:]) / 2
        weights = torch.load(weights_path(Path("run"), record), weights_only=True)
        assert [tuple(value.shape) for value in weights.values()] == [(5, 18, 9), (5, 9), (5, 18)]
        exact = record.method == "exact"
        assert all((error < 1e-6) == exact for error in record.measures["relative_error"][0])

    path = Path("run/records.jsonl")
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    assert memcomp_train("resume=run").status == 0
    again = records()
    assert again[-1].key == found[-1].key
    assert again[-1].measures["score"] == found[-1].measures["score"]

    for name in ("shifting_bars.png", "shifting_bars.svg", "sampler_worth.csv", "verdicts.md", "report.html"):
        assert Path("run", name).stat().st_size > 0
    events = EventAccumulator("run/tensorboard/CD-1").Reload()
    median = events.Scalars("shifting_bars/kl/median")
    best = read_worth(Path("run")).best("shifting_bars", "cd1")
    assert [event.step for event in median] == best.at
    assert median[-1].value == pytest.approx(sorted(best.measures["score"][-1][:3])[1], rel=1e-6)
    assert any(b"method" in file.read_bytes() for file in Path("run/tensorboard/CD-1").rglob("events*"))
    layout = EventAccumulator("run/tensorboard").Reload()
    assert "custom_scalars__config__" in layout.Tags()["tensors"]


def test_a_replica_is_the_single_run(memcomp_train: Run) -> None:
    """Of the exact gradient, which draws nothing: the fourth replica is the run with seed 3."""
    only = ("+worth.data_sets.shifting_bars.methods=", "worth.claimed=", "worth.baselines=")
    settings = [setting for setting in SMALL if not setting.startswith(only)]
    methods = f"{only[0]}[exact]"
    assert memcomp_train(*settings, methods, "worth.claimed=[exact]", "worth.baselines=[]").status == 0
    decay = "{_target_:memcomp_lightning.training.LearningRateDecay,n_passes:40}"
    single = memcomp_train(
        "preset=paper",
        "data=shifting_bars",
        "model.hidden_sizes=[18]",
        "sampler=exact",
        "pretrain.iterations=40",
        "pretrain.optimizer.lr=0.5",
        "finetune.iterations=0",
        "pretrain.schedules.momentum=null",
        f"pretrain.schedules.decay={decay}",
        "seed=3",
        "hydra.run.dir=single",
    )
    assert single.status == 0, single.err
    dbn = DBN(9, [18])
    dbn.load_state_dict(torch.load("single/weights/pretrain.pt", weights_only=True))
    (record,) = [r for r in records() if (r.method, r.value) == ("exact", 0.5)]
    found = kl_divergence(dbn[0], ShiftingBars().load().train_v)
    assert record.measures["score"][-1][3] == pytest.approx(float(found), rel=1e-4)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("worth.data_sets.shifting_bars.measure=accuracy", "measure = 'accuracy'"),
        ("worth.claimed=[cd2]", "'cd2'"),
        ("worth.rates=[]", "worth.rates = []"),
        ("worth.methods.cd1.rates=[]", "worth.methods.cd1.rates = []"),
        ("worth.only=[bars]", "worth.only = 'bars'"),
        ("worth.data_sets.shifting_bars.measure=ais", "data.validation_fraction = 0.0"),
        ("worth.replicas=0", "worth.replicas = 0"),
        ("+worth.methods.cd1.faster=2", "setting of worth.methods.cd1 = 'faster'"),
        ("worth.methods.cd1.overrides=['sampler=cdd']", "cdd"),
        ("worth.methods.cd1.overrides=['sampler=cd','sampler.kk=10']", "kk"),
        ("worth.rates=[0.1,-1]", "learning rate"),
        ("data.partitions=3", "data.partitions = (3,)"),
        ("trainer.accelerator=gpu", "trainer.accelerator = 'gpu'"),
        ("preset=quick", "preset=quick is one of figures"),
    ],
)
def test_wrong_settings_are_refused_before_training(memcomp_train: Run, override: str, message: str) -> None:
    outcome = memcomp_train(*SMALL, override)
    assert outcome.status != 0
    assert message in outcome.err
    assert not Path("run").exists()


def test_divergence_is_a_result(memcomp_train: Run) -> None:
    outcome = memcomp_train(*SMALL, "worth.methods.cd1.rates=[1e30]")
    assert outcome.status == 0, outcome.err
    (record,) = [r for r in records() if r.method == "cd1"]
    assert record.measures["score"][-1] == [float("inf")] * 5
    assert json.loads(Path("run/worth.json").read_text())["methods"]["cd1"]["rates"] == [1e30]


def test_likelihoods_are_chosen_by_held_out_images_and_bracketed(memcomp_train: Run) -> None:
    """Exact and AIS agree on the same courses; replicas that choose are scored by other images."""
    data = [
        "data=digits",
        "data.source.pixels=threshold",
        "data.validation_fraction=0.2",
        "pretrain.batch_size=100",
    ]
    data = ",".join(f"'{setting}'" for setting in (*data, "model.hidden_sizes=[8]"))
    common = f"label:digits,passes:6,methods:[cd1],rates:[0.5],points:2,overrides:[{data}]"
    outcome = memcomp_train(
        *SMALL,
        *[f"+worth.data_sets.{m}={{{common},measure:{m}}}" for m in ("log_likelihood", "ais")],
        "worth.only=[log_likelihood,ais]",
        "worth.claimed=[]",
    )
    assert outcome.status == 0, outcome.err
    exact, ais = records()
    true = exact.measured("score")
    assert true.shape == ais.measured("reverse").shape == (2, 5)
    assert "reverse" not in exact.measures
    assert ais.measured("score") == pytest.approx(true, abs=0.1)
    assert ais.measured("reverse") == pytest.approx(true, abs=0.1)

    rbm = RBM(n_visible=32, n_hidden=8, replicas=(5,))
    rbm.load_state_dict(torch.load(weights_path(Path("run"), exact), weights_only=True))
    module = ImageDataModule(Digits(pixels="threshold").load(), batch_size=100, validation_fraction=0.2)
    assert module.validation is not None
    for v, at in ((module.images.test_v, slice(0, 3)), (module.validation[0], slice(3, 5))):
        score = -log_likelihood(rbm, v, log_partition_function(rbm)).mean(-1)
        assert true[-1][at] == pytest.approx(score[at].numpy(), rel=1e-6)


def test_mean_gradient_of_mode_assistance_weighs_both_sides() -> None:
    rbm = RBM(n_visible=4, n_hidden=3, replicas=(2,), weight_init=Normal(std=1.0), generator=rng.stream(0, "w"))
    exact, schedule = Exact(), ModeSchedule(n_updates=10)
    sampler = ModeAssisted(inner=exact, mode=GroundState(solver=BruteForce()), schedule=schedule)
    generator = rng.stream(0, "negative_phase")
    positive = positive_phase(rbm, torch.eye(4).expand(2, 4, 4))
    state = sampler.init(rbm, 4, generator=generator)._replace(n_done=torch.tensor(schedule.n_updates))
    found = mean_gradient(rbm, sampler, state, positive, 3, generator=generator)
    parts = [
        gradient(rbm, positive, negative.configurations).double()
        for negative in (
            exact.sample(rbm, state.inner, positive, generator=generator),
            sampler.sample_mode(rbm, state, positive, generator=generator),
        )
    ]
    torch.testing.assert_close(found, 0.9 * parts[0] + 0.1 * parts[1], rtol=1e-5, atol=1e-9)
