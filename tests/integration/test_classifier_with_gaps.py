"""Fine-tuning where inputs are missing: the pretrained model draws them, anew each time, and nobody else."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hydra import compose
from running import QUIET, Outcome

from memcomp_lightning import rng
from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.configuration.plans import build
from memcomp_lightning.models import DBN, RBM, Normal
from memcomp_lightning.modules import Classifier, DBNClassifier
from memcomp_lightning.training import ClassWeighted, cross_entropy, evaluate, squared_error
from memcomp_lightning.training.filling import N_DRAWS, Filling
from memcomp_lightning.types import Batch

Run = Callable[..., Outcome]
TABLE = [*QUIET, "data=table", "data.path=rows.csv", "data.columns={label: kind}", "model.hidden_sizes=[6]"]
SHORT = ["pretrain.iterations=2", "finetune.iterations=2", "hydra.run.dir=run"]


@pytest.fixture
def rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each row one cell is empty."""
    monkeypatch.chdir(tmp_path)
    lines = []
    for k in range(60):
        cells = ["abc"[k % 3], str(k % 2), f"{k * 37 % 11 / 10}"]
        cells[k % 3] = ""
        lines.append(",".join([*cells, "xy"[k % 2]]))
    Path("rows.csv").write_text("\n".join(["letter,bit,size,kind", *lines]) + "\n")


def model() -> RBM:
    return RBM(4, 2, weight_init=Normal(std=2.0), generator=rng.stream(3, "weights"))


def batch(n: int = 6) -> Batch:
    v = (rng.uniform((n, 4), generator=rng.stream(0, "v")) < 0.5).float()
    observed = rng.uniform((n, 4), generator=rng.stream(1, "observed")) < 0.6
    return Batch(torch.where(observed, v, 0.0), torch.arange(n) % 3, 1.0, True, None, observed)


def network() -> torch.nn.Module:
    init = Normal(std=2.0)
    dbn = DBN(4, [3], weight_init=init, generator=rng.stream(4, "weights"))
    return DBNClassifier(dbn, n_classes=3, output_init=init, generator=rng.stream(5, "weights")).network.eval()


def test_draws_follow_the_model_given_what_is_observed() -> None:
    rbm, n = model(), 4000
    v = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, -1)
    observed = torch.tensor([True, True, False, False]).expand(n, -1)
    filling = Filling(rbm)
    with torch.no_grad():
        rbm.weight.zero_()  # the copy stays as it is
        found = filling.complete(Batch(v, torch.zeros(n), 1.0, True, None, observed), rng.stream(0, "missing"))
        states = torch.tensor([[1.0, 0, a, b] for a in (0, 1) for b in (0, 1)])
        expected = torch.softmax(-model().free_energy(states), 0)
    assert found.observed is None
    assert found.v[:, :2].equal(v[:, :2])
    share = torch.bincount((2 * found.v[:, 2] + found.v[:, 3]).long(), minlength=4) / n
    assert ((share - expected).abs() < 5 * (expected * (1 - expected) / n).sqrt()).all()
    assert (expected - 0.25).abs().max() > 0.1  # else a coin would do


def test_each_pass_has_draws_of_its_own() -> None:
    filling, generator = Filling(model()), rng.stream(0, "missing")
    assert not filling.complete(batch(), generator).v.equal(filling.complete(batch(), generator).v)


@pytest.mark.parametrize("loss", [cross_entropy, squared_error, ClassWeighted(squared_error, torch.ones(3))])
def test_rows_are_judged_by_mean_probabilities(loss: object) -> None:
    filling, made, generator = Filling(model(), seed=7), network(), rng.stream(7, "missing values, judged", 2)
    with torch.no_grad():
        drawn = [made(filling.complete(batch(), generator).v) for _ in range(N_DRAWS)]
        found = filling.judged(made, batch(), 2, loss)  # type: ignore[arg-type]
    of = torch.Tensor.sigmoid if loss is not cross_entropy else lambda x: x.softmax(-1)
    torch.testing.assert_close(of(found), torch.stack([of(x) for x in drawn]).mean(0), atol=1e-5, rtol=1e-5)
    one, again = (evaluate(made, [batch()], filling=Filling(model())).loss for _ in range(2))
    assert one.equal(again)


@pytest.mark.usefixtures("rows")
@pytest.mark.parametrize("way", ["pretrain=centred", "pretrain=joint"])
def test_a_run_with_gaps(memcomp_train: Run, way: str, request: pytest.FixtureRequest) -> None:
    outcome = memcomp_train(*TABLE, way, *SHORT)
    assert outcome.status == 0, outcome.err
    said = "the pretrained model draws them, anew in each pass; held-out and test rows are judged by the mean"
    assert (outcome.out + outcome.err).count(said) == 1
    assert "logistic regression" not in outcome.out
    first = json.loads(Path("run/result.json").read_text())
    weights = torch.load("run/weights/finetune.pt", weights_only=True)
    # Fine-tuned once more, after an end between the stages:
    stages = json.loads(Path("run/stages.json").read_text())
    Path("run/stages.json").write_text(json.dumps({"pretrain": stages["pretrain"]}))
    Path("run/result.json").unlink()
    Path("run/weights/finetune.pt").unlink()
    assert memcomp_train("resume=run").status == 0
    again = torch.load("run/weights/finetune.pt", weights_only=True)
    assert all(x.equal(weights[name]) for name, x in again.items())
    assert json.loads(Path("run/result.json").read_text())["test_loss"] == first["test_loss"]


@pytest.mark.usefixtures("rows")
def test_what_fills_is_the_pretrained_model_whatever_fine_tuning_does() -> None:
    with composing():
        plan = build(compose("config", TABLE))
    assert plan.finetuning is not None
    assert isinstance(plan.network, DBN)
    assert isinstance(plan.finetuning.module, Classifier)
    plan.fill_gaps(0)
    before = plan.network[0].weight.clone()
    with torch.no_grad():
        plan.network[0].weight.add_(1)
    filling = plan.finetuning.module.filling
    assert filling is not None
    assert filling._model.weight.equal(before)
    assert not any("filling" in name for name in plan.finetuning.module.state_dict())


@pytest.mark.usefixtures("rows")
@pytest.mark.parametrize(
    "settings",
    [
        ["model=baseline_bn_relu", "pretrain.iterations=0"],
        ["pretrain.iterations=0"],
        ["choose={setting:pretrain.optimizer.lr,values:[0.1]}"],
    ],
    ids=" ".join,
)
def test_nobody_else_fills(memcomp_train: Run, settings: list[str]) -> None:
    outcome = memcomp_train(*TABLE, *SHORT, *settings)
    assert outcome.status != 0
    assert "missing values = 'in the data of a classifier'" in outcome.err
    assert "memcomp-impute" in outcome.err
    assert not Path("run").exists()
