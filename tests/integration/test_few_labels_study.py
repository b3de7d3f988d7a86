"""``experiment=few_labels`` in small: pretraining once, methods, resume, report, and what is refused."""

from collections.abc import Callable
from pathlib import Path

import pytest
from running import Outcome

from memcomp_lightning.studies import Record, Records

Run = Callable[..., Outcome]
SMALL = [
    "experiment=few_labels",
    "preset=quick",
    "data=digits",
    "few_labels.labels=[20]",
    "few_labels.pretrainings=1",
    "few_labels.only=[cd,bn_relu,cd_shuffled,pseudo_bn_relu,regression]",
    "few_labels.updates=8",
    "few_labels.passes=2",
    "few_labels.measured=2",
    "few_labels.searches.network.axes={rate:[0.1,0.2],weight_decay:[0.0],dropout:[0.0]}",
    "few_labels.searches.pseudo_labels.axes.share=[0.0,0.5]",
    "few_labels.workers=1",
    "model.hidden_sizes=[6,5]",
    "pretrain.iterations=1",
    "hydra.run.dir=run",
]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def records() -> list[Record]:
    return Records(Path("run")).all


def test_methods_are_measured_on_the_same_draws_and_a_run_goes_on(memcomp_train: Run, here: Path) -> None:
    outcome = memcomp_train(*SMALL)
    assert outcome.status == 0, outcome.err
    found = records()
    pretrained, measured = ([one for one in found if bool(one.data_set) == is_one] for is_one in (True, False))
    assert [(one.method, one.seed) for one in pretrained] == [("cd", 0)]
    names = ("cd", "bn_relu", "cd_shuffled", "pseudo_bn_relu", "regression")
    assert {(one.method, one.labels, one.seed) for one in measured} == {
        (n, 20, draw) for n in names for draw in (0, 1)
    }
    assert all(0 <= one.measures["test_accuracy"][0][0] <= 1 for one in measured)
    assert "is above batch norm + ReLU" in outcome.out
    for name in ("few_labels.png", "few_labels.csv", "verdicts.md", "report.html", "pretrained/cd_0.pt"):
        assert Path("run", name).stat().st_size > 0

    path, weights = Path("run/records.jsonl"), Path("run/pretrained/cd_0.pt")
    written = weights.stat().st_mtime_ns
    path.write_text("".join(line + "\n" for line in path.read_text().splitlines()[:-2]))
    assert memcomp_train("resume=run").status == 0
    assert weights.stat().st_mtime_ns == written
    again = records()
    assert len(again) == len(found)
    for first, second in zip(sorted(found, key=str), sorted(again, key=str), strict=True):
        assert (first.key, first.measures["test_accuracy"] if not first.data_set else 0) == (
            second.key,
            second.measures["test_accuracy"] if not second.data_set else 0,
        )


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (
            "few_labels.labels=[2000]",
            "few_labels.labels = 2000 is not allowed: expected an integer from 10",
        ),
        ("few_labels.labels=[5]", "few_labels.labels = 5"),
        ("few_labels.only=[nothing]", "few_labels.only = 'nothing'"),
        ("few_labels.only=[pseudo_cd]", "name both"),
        ("sampler=cd", "Each of few_labels.pretraining has its own"),
        ("data.validation_fraction=0.1", "cross-validation takes its place"),
        ("data.partitions=2", "draws take their place"),
    ],
)
def test_a_study_that_cannot_be_is_refused_before_anything_trains(
    memcomp_train: Run, here: Path, typed: str, said: str
) -> None:
    outcome = memcomp_train(*(o for o in SMALL if o.split("=")[0] != typed.split("=")[0]), typed)
    assert outcome.status != 0
    assert said in outcome.err
    assert not Path("run/records.jsonl").exists()
