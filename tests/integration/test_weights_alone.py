"""``memcomp_lightning.load`` of what is not a finished run folder: checkpoints, moved files, replicas."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from running import QUIET, Outcome

from memcomp_lightning import load, rng
from memcomp_lightning.cli import score, train
from memcomp_lightning.data.sequences import SequenceSchema
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.models import DBN, RBM, Normal
from memcomp_lightning.models.units import Spin
from memcomp_lightning.modules import CheckpointError
from memcomp_lightning.runs import pipeline
from memcomp_lightning.trained import LoadWarning
from memcomp_lightning.trained.training_rows import training_rows

pytest.importorskip("pyarrow")

TABLE = "age,sex,colour,species\n" + "".join(
    f"{20 + 7 * (i % 5) + i % 3},{'fm'[i % 2]},{['red', 'green', 'blue'][i % 3]},{['cat', 'dog'][i % 2]}\n"
    for i in range(60)
)
TRAIN = [
    *("data=table", "data.path=people.csv", "data.columns={label: species}", "model.hidden_sizes=[4]"),
    *(*QUIET, "pretrain.iterations=1", "finetune.iterations=1", "checkpoint_every=1", "hydra.run.dir=run"),
]

Command = Callable[..., Outcome]


@pytest.fixture
def stopped(run_command: Command, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that was killed before fine-tuning left its weights."""
    Path("people.csv").write_text(TABLE)

    def save(module: torch.nn.Module, path: Path) -> None:
        if path.stem == "finetune":
            raise KeyboardInterrupt
        torch.save(module.state_dict(), path)

    Path("run/weights").mkdir(parents=True)
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "save_weights", save)
        assert run_command("memcomp-train", train.main, tuple(TRAIN)).status == 130
    return Path("run")


def test_a_checkpoint_is_loaded(stopped: Path, run_command: Command) -> None:
    path = stopped / "checkpoints/finetune/last.ckpt"
    run = load(path)
    written = torch.load(path, weights_only=True)["state_dict"]
    assert run.classifier is not None
    assert run.schema is not None
    assert run.schema.class_names == ["cat", "dog"]
    for name, x in run.classifier.state_dict().items():
        assert torch.equal(x, written[f"network.{name}"])
    pretrained = torch.load(stopped / "weights/pretrain.pt", weights_only=True)
    assert torch.equal(run.model.b, pretrained["rbms.0.b"])
    with pytest.warns(LoadWarning, match="run has not finished: it has pretrain alone. Go on with"):
        assert load(stopped).classifier is None

    # Moved away from its run, it needs to be told what its units stand for.
    shutil.copy(path, "moved.ckpt")
    shutil.copy(stopped / "weights/pretrain.pt", "moved.pt")
    for moved in ("moved.ckpt", "moved.pt"):
        with pytest.raises(UserError, match=r"give the schema of the run, schema=FOLDER/schema\.json"):
            load(moved)
    with pytest.warns(LoadWarning, match="its outputs are taken for logits of softmax"):
        again = load("moved.ckpt", schema="run/schema.json")
    v = run.model.visible.sample(torch.zeros(5, 5), generator=rng.stream(0, "v"))
    assert again.classifier is not None
    assert torch.equal(again.classifier(v), run.classifier(v))
    with pytest.raises(UserError, match=r"no energy model of the data\. Name its run folder"):
        _ = again.model
    assert torch.equal(load("moved.pt", schema=run.schema).model.free_energy(v), run.model.free_energy(v))
    own = DBN(visible=run.schema.units(), hidden_sizes=[4])
    assert load("moved.pt", network=own, schema="run/schema.json").needed_schema.site_names == [
        "sex",
        "colour",
        "age",
    ]

    outcome = run_command("memcomp-score", score.main, ("moved.pt", "people.csv", "schema=run/schema.json"))
    assert outcome.status == 0, outcome.err
    assert "60 rows, mean log-likelihood" in outcome.out
    outcome = run_command("memcomp-score", score.main, ("moved.pt", "people.csv", "overwrite=true"))
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    unfinished = run_command("memcomp-score", score.main, ("run", "people.csv", "overwrite=true"))
    assert unfinished.err.startswith("memcomp-score: warning: run has not finished: it has pretrain alone")
    assert unfinished.err.count("\n") == 1


def test_a_run_killed_in_pretraining_names_its_checkpoint(stopped: Path) -> None:
    (stopped / "weights/pretrain.pt").unlink()
    with pytest.raises(UserError, match=r"or name its checkpoint as it is, run/checkpoints/finetune/last\.ckpt"):
        load(stopped)


@pytest.mark.parametrize(
    ("schema", "said"),
    [
        ("nothing.json", r"schema=nothing\.json: No such file or directory"),
        ("a.pt", r"schema=a\.pt is no schema of a run"),
        (
            SequenceSchema(3, "dna"),
            "and the schema 15: it is that of another run",
        ),
    ],
)
def test_a_schema_that_fits_nothing(
    schema: str | SequenceSchema, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save(DBN(6, [2]).state_dict(), "a.pt")
    with pytest.raises((UserError, CheckpointError), match=said):
        load("a.pt", schema=schema)


def test_no_code_in_a_checkpoint_runs(tmp_path: Path) -> None:
    class Runs:
        def __reduce__(self) -> tuple[object, ...]:
            return os.mkdir, (str(tmp_path / "made"),)

    torch.save({"state_dict": {"network.weight": Runs()}}, tmp_path / "last.ckpt")
    with pytest.raises(CheckpointError, match="code in checkpoints is never executed"):
        load(tmp_path / "last.ckpt")
    assert not (tmp_path / "made").exists()


def test_which_of_several_networks_is_taken_is_said(tmp_path: Path) -> None:
    drawn = RBM(5, 3, replicas=(2,), weight_init=Normal(std=1.0), generator=rng.stream(0, "weights"))
    path = tmp_path / "several.pt"
    torch.save(drawn.state_dict(), path)
    spins = RBM(visible=Spin(5), n_hidden=3)
    with pytest.warns(LoadWarning, match=r"has 2 networks, trained side by side: the first is taken\. Choose by"):
        assert torch.equal(load(path, network=spins).model.weight, drawn.weight[0])
    assert torch.equal(load(path, network=spins, replica=1).model.weight, drawn.weight[1])
    with pytest.raises(SettingError, match="replica = 2 is not allowed: expected an integer from 0 to 1"):
        load(path, network=spins, replica=2)
    with pytest.warns(LoadWarning, match="taken for bits"):
        assert torch.equal(load(path, replica=1).model.weight, drawn.weight[1])


def test_which_of_the_networks_of_a_run_is_taken_is_said(run_command: Command) -> None:
    Path("people.csv").write_text(TABLE)
    settings = [*TRAIN, "finetune.iterations=0", "data.partitions=2"]
    assert run_command("memcomp-train", train.main, tuple(settings)).status == 0
    outcome = run_command("memcomp-score", score.main, ("run", "people.csv"))
    said = (
        "memcomp-score: warning: run has 2 networks, trained side by side: the first is taken. Choose by replica=0"
    )
    assert outcome.err == f"{said} to 1.\n"
    second = run_command("memcomp-score", score.main, ("run", "people.csv", "replica=1", "output=second.csv"))
    assert (second.status, second.err) == (0, "")
    assert Path("second.csv").read_text() != Path("scores.csv").read_text()
    of_both = [training_rows(load("run", replica=k)).train for k in (0, 1)]
    assert [rows.n for rows in of_both] == [27, 27]
    assert not torch.equal(of_both[0].v, of_both[1].v)
