"""A study of few labels: who sees which labels, what is chosen by them, and what its verdicts say."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from memcomp_lightning import rng
from memcomp_lightning.data import ImageData, ImageDataModule, PixelLayout
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, Shuffled
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.modules.weights import save_weights
from memcomp_lightning.samplers import CD
from memcomp_lightning.studies.few_labels import (
    Accuracies,
    BatchNormRelu,
    DenoisingAutoencoder,
    FewLabels,
    HiddenMeans,
    LabelRbm,
    LabelsTrial,
    Network,
    Pixels,
    Pretrained,
    PrincipalComponents,
    PseudoLabels,
    Regression,
    SupportVectors,
)
from memcomp_lightning.studies.few_labels.data import Sets, drawn, folded, whole
from memcomp_lightning.studies.few_labels.label_rbm import FreeEnergyClassifier, with_class
from memcomp_lightning.studies.few_labels.learner import Context, Lengths, Point, weight_file
from memcomp_lightning.studies.few_labels.plot import few_labels_figures
from memcomp_lightning.studies.few_labels.pseudo import _with_pseudo_labels, _without_label
from memcomp_lightning.studies.few_labels.results import few_labels_table, few_labels_verdicts, worth_note
from memcomp_lightning.studies.few_labels.settings import Claim, Method, Pretraining, Search
from memcomp_lightning.studies.few_labels.trial import PRETRAINING, chosen_of
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.studies.records import Record
from memcomp_lightning.training import Greedy

N_TRAIN, N_TEST, N_VISIBLE, N_CLASSES = 120, 30, 6, 3


def images(*, otherwise: bool = False) -> ImageData:
    """Rows whose first three pixels are their class with noise; or otherwise, but for 15 labels of draw 1."""
    draw = rng.stream(5, "few labels")
    label = torch.arange(N_TRAIN) % N_CLASSES
    v = 0.5 * rng.uniform((N_TRAIN, N_VISIBLE), generator=draw)
    v[torch.arange(N_TRAIN), label] += 0.4
    if otherwise:
        label = with_others_swapped(label)
    test_v = rng.uniform((N_TEST, N_VISIBLE), generator=rng.stream(int(otherwise), "test"))
    test_label = (torch.arange(N_TEST) + int(otherwise)) % N_CLASSES
    layout = PixelLayout(height=1, width=N_VISIBLE)
    return ImageData(v, label, test_v, test_label, N_CLASSES, layout, "noisy classes")


def with_others_swapped(label: torch.Tensor) -> torch.Tensor:
    """Other labels for most rows that are not drawn, so that the same ones are drawn."""
    own = drawn(label, 15, 1)
    for first in range(0, N_TRAIN - 1, 2):
        swapped = label.clone()
        swapped[[first, first + 1]] = label[[first + 1, first]]
        found = drawn(swapped, 15, 1)
        if found.at.equal(own.at) and found.label.equal(own.label):
            label = swapped
    return label


def plan(data: ImageData, settings: dict[str, int]) -> Plan:
    dbn = DBN(N_VISIBLE, [5, 4], generator=rng.stream(settings["seed"], "weights"))
    module = EnergyPretraining(Greedy(dbn), CD(), iterations=1)
    return Plan(dbn, Stage(module, ImageDataModule(data), []), None)


SEARCHES = {"rates": Search(axes={"rate": [0.05, 0.2]}, start={"rate": 0.05})}


def study(**settings: object) -> FewLabels:
    common: dict[str, object] = {
        "name": "few_labels",
        "title": "few",
        "labels": [15, 60],
        "draws": 4,
        "draws_of_all": 1,
        "pretrainings": 1,
        "only": None,
        "folds": 5,
        "folds_of_many": 3,
        "many": 30,
        "updates": 8,
        "passes": 2,
        "measured": 2,
        "batch_sizes": [5, 10],
        "overrides": [],
        "pretraining": {"cd": Pretraining(overrides=[])},
        "searches": SEARCHES,
        "methods": {
            name: Method(label=name.upper(), panel="p", search="rates", learner={})
            for name in ("cd", "pcd", "cd_shuffled", "pcd_shuffled", "bn", "spy")
        },
        "claims": [],
        "candidates": ["cd", "pcd"],
        "worth": ["bn", "{best}_shuffled"],
        "workers": 1,
    }
    return FewLabels(**{**common, **settings})  # type: ignore[arg-type]


def trial(data: ImageData, learner: object, **own: object) -> LabelsTrial:
    common: dict[str, object] = {"method": "spy", "seed": 1, "labels": 15, "settings": {}, "folder": ""}
    made = {**common, "build": partial(plan, data), "learner": learner, "study": study(), **own}
    return LabelsTrial(**made)  # type: ignore[arg-type]


def silent(what: str, n: int) -> None:
    pass


@dataclass
class Spy:
    """Keeps what it was shown, and likes the higher rate."""

    shown: list[tuple[Sets, Sequence[int] | None]] = field(default_factory=list)

    def learn(
        self, context: Context, sets: Sets, setting: dict[str, float], passes: Sequence[int] | None
    ) -> list[Point]:
        self.shown.append((sets, passes))
        value = torch.full((sets.n_sets,), setting["rate"])
        return [Point(done, value + 0.01 * done, 0 * value) for done in passes or (1, 3)]


def test_draws_are_balanced_and_each_number_is_one() -> None:
    label = images().train_label
    first, second = drawn(label, 15, 0), drawn(label, 15, 1)
    assert label[first.at].equal(first.label)
    assert first.label.bincount().tolist() == [5, 5, 5]
    assert not first.at.equal(second.at)
    assert first.at.equal(drawn(label, 15, 0).at)
    assert len(drawn(label, None, 3).at) == N_TRAIN
    with pytest.raises(SettingError, match="at most the 120 training rows"):
        drawn(label, 121, 0)


@pytest.mark.parametrize(("n", "n_folds"), [(15, 5), (17, 5), (60, 3), (3, 3)])
def test_folds_share_the_labelled_rows_out(n: int, n_folds: int) -> None:
    data = images()
    own = drawn(data.train_label, n, 2)
    sets = folded(data.train_v, own, n_folds, N_CLASSES, 2)
    size = n // n_folds
    assert sets.at.shape == (n_folds, n - size)
    assert sets.judging_at.shape == (n_folds, size)
    assert sets.judging_at.flatten().unique().numel() == n_folds * size  # no row judges twice
    for at, judging in zip(sets.at, sets.judging_at, strict=True):
        assert sorted([*at.tolist(), *judging.tolist()]) == own.at.tolist()
    counts = torch.stack([label.bincount(minlength=N_CLASSES) for label in sets.judging_label])
    assert (counts.amax(0) - counts.amin(0)).max() <= 1  # each class has its share of each fold
    assert data.train_label[sets.at].equal(sets.label)
    assert data.train_label[sets.judging_at].equal(sets.judging_label)


def test_all_methods_have_the_same_labels_and_choose_by_them_alone() -> None:
    data = images()
    spies = [Spy(), Spy()]
    for spy, name in zip(spies, ("spy", "bn"), strict=True):
        (record,) = trial(data, spy, method=name).run(silent)
        *choosing, last = spy.shown
        own = last[0].at[0]
        for sets, passes in choosing:
            assert passes is None
            assert sets.judging is sets.rows  # not test rows
            assert sets.rows.equal(data.train_v)
            assert torch.isin(sets.at, own).all()
            assert torch.isin(sets.judging_at, own).all()
        assert last[0].judging.equal(data.test_v)
        assert last[1] == (3,)  # the better one of those measured
        assert chosen_of(record) == {"rate": 0.2, "passes": 3.0}
        assert record.held_out == pytest.approx(0.23)
        assert record.measures["labels"] == [[15.0]]
    for (first, _), (second, _) in zip(*(spy.shown for spy in spies), strict=True):
        assert first.at.equal(second.at)


LEARNERS = {
    "network": Network(start=Pretrained()),
    "batch norm": Network(start=BatchNormRelu()),
    "shuffled": Network(start=Pretrained(change=Shuffled())),
    "regression": Regression(features=Pixels(), most=None),
    "components": Regression(features=PrincipalComponents(), most=None),
    "support vectors": SupportVectors(features=HiddenMeans(), most=9),
    "class unit": LabelRbm(layer=0, discriminative=True, generative=0.1),
    "top class unit": LabelRbm(layer=1, discriminative=False, generative=1.0),
    "pseudo-labels": PseudoLabels(base=Network(start=BatchNormRelu()), unlabelled=40, passes=(1, 2)),
}
PRETRAINED = {"shuffled", "support vectors", "class unit", "top class unit"}
TUNED = {
    "regression": {"C": [0.1, 10.0]},
    "components": {"components": [2, 3], "C": [0.1, 10.0]},
    "support vectors": {"C": [1.0, 100.0], "gamma": [0.3, 1.0]},
    "pseudo-labels": {"share": [0.0, 0.5]},
}


@pytest.mark.parametrize("name", LEARNERS)
def test_nothing_but_its_own_labels_moves_what_a_method_chooses(name: str, tmp_path: Path) -> None:
    save_weights(DBN(N_VISIBLE, [5, 4], generator=rng.stream(7, "weights")), weight_file(tmp_path, "cd", 0))
    axes = TUNED.get(name, {"rate": [0.05, 0.2]})
    search = Search(axes=axes, start={key: values[0] for key, values in axes.items()})
    found = []
    assert int((images().train_label != images(otherwise=True).train_label).sum()) > 40
    for data in (images(), images(otherwise=True)):
        of = "cd" if name in PRETRAINED else None
        spy = Method(label="SPY", panel="p", search="rates", learner={}, pretraining=of)
        own = study(searches={"rates": search}, methods={**study().methods, "spy": spy})
        base = {"rate": 0.2, "passes": 2.0} if name == "pseudo-labels" else None
        one = trial(data, LEARNERS[name], folder=str(tmp_path), study=own, base=base)
        found.append(one.run(silent)[0])
    first, second = found
    assert chosen_of(first) == chosen_of(second)
    assert first.held_out == second.held_out
    assert first.key == second.key


def context(tmp_path: Path, data: ImageData, pretraining: str | None = None) -> Context:
    lengths = Lengths(updates=200, passes=5, measured=3, batch_sizes=[5, 20])
    blank = DBN(N_VISIBLE, [5, 4])
    settings: dict[str, Any] = {"pretraining": pretraining, "folder": tmp_path, "pretrained_by": 0, "seed": 0}
    return Context(blank=blank, **settings, lengths=lengths, rows=data.train_v)


def test_a_dbn_has_the_weights_of_its_pretraining_each_time_anew(tmp_path: Path) -> None:
    pretrained = DBN(N_VISIBLE, [5, 4], generator=rng.stream(7, "weights"))
    save_weights(pretrained, weight_file(tmp_path, "cd", 0))
    data = images()
    for name, expected in (("cd", pretrained), (None, DBN(N_VISIBLE, [5, 4]))):
        given = context(tmp_path, data, name)
        first = Pretrained(change=Shuffled()).network(given, N_CLASSES)
        assert not first[0][0].weight.equal(expected[0].weight)  # type: ignore[index]
        assert given.dbn()[0].weight.equal(expected[0].weight)


def test_classes_follow_from_free_energies() -> None:
    data = images()
    sets = folded(data.train_v, drawn(data.train_label, 15, 0), 5, N_CLASSES, 0)
    rbm = with_class(DBN(N_VISIBLE, [5, 4], generator=rng.stream(1, "weights"))[0], sets, 3)
    with torch.no_grad():
        for parameter in rbm.parameters():
            parameter.normal_(generator=rng.stream(2, "parameters"))
    v, classes = data.train_v[:4], torch.eye(N_CLASSES)
    logits = FreeEnergyClassifier(rbm, N_CLASSES)(v.expand(5, -1, -1))
    for number, one_hot in enumerate(classes):
        full = torch.cat((v, one_hot.expand(4, -1)), dim=-1).expand(5, -1, -1)
        expected = -rbm.free_energy(full) - (v @ rbm.b[:, :N_VISIBLE].mT).mT
        torch.testing.assert_close(logits[..., number], expected)


@pytest.mark.parametrize("name", ["batch norm", "regression", "class unit"])
def test_what_can_be_learned_is_learned(name: str, tmp_path: Path) -> None:
    data = images()
    save_weights(DBN(N_VISIBLE, [5, 4]), weight_file(tmp_path, "cd", 0))
    own = drawn(data.train_label, 60, 0)
    held = torch.arange(N_TRAIN)[~torch.isin(torch.arange(N_TRAIN), own.at)]
    sets = whole(data.train_v, own, (data.train_v[held], data.train_label[held]), N_CLASSES, 0)
    setting = {"rate": 0.02 if name == "batch norm" else 0.2, "C": 10.0}
    of = "cd" if name in PRETRAINED else None
    points = LEARNERS[name].learn(context(tmp_path, data, of), sets, setting, None)
    assert float(points[-1].accuracy[0]) > 0.8
    assert [point.passes for point in points] == ([0] if name == "regression" else [4, 8, 17])


def test_components_have_variance_one_and_are_those_of_all_rows(tmp_path: Path) -> None:
    data = images()
    features = PrincipalComponents().of(data.train_v, context(tmp_path, data), {"components": 4})
    torch.testing.assert_close(features.T @ features / N_TRAIN, torch.eye(4), atol=1e-4, rtol=0)
    centred = data.train_v - data.train_v.mean(0)
    left = torch.linalg.svd(centred, full_matrices=False).U[:, :4] * N_TRAIN**0.5
    torch.testing.assert_close(features.abs(), left.abs(), atol=1e-3, rtol=0)


def test_an_autoencoder_restores_what_is_missing() -> None:
    rows = images().train_v.round()
    pair = torch.cat((rows[:, :3], rows[:, :3]), dim=-1)  # each pixel twice: one tells the other
    dbn, way = DBN(6, [12, 4]), DenoisingAutoencoder(noise=0.3, passes=40, rate=0.03, batch_size=20)
    done: list[int] = []
    way.train(dbn, pair, 0, done.append)
    assert done == list(range(1, 81))
    with torch.no_grad():
        generator = rng.stream(1, "noise")
        restored = float(way.loss(dbn[0], pair, generator))
    mean = pair.mean(0).clamp(0.01, 0.99)
    alone = float(-(pair * mean.log() + (1 - pair) * (1 - mean).log()).sum(-1).mean())
    assert restored < 0.6 * alone


def test_pseudo_labels_are_of_rows_without_one(tmp_path: Path) -> None:
    data = images()
    sets = folded(data.train_v, drawn(data.train_label, 15, 0), 3, N_CLASSES, 0)
    network = Network(start=BatchNormRelu())
    *_, (_, trained) = network.fit(context(tmp_path, data), sets, {"rate": 0.1}, (10,))
    others = _without_label(sets, 50)
    assert len(others) == 50
    assert not torch.isin(others, sets.at).any()
    at, label = _with_pseudo_labels(trained, sets, others, 20)
    assert at[:, :20].equal(sets.at.repeat(1, 2))  # ten rows twice beside twenty
    assert label[:, :20].equal(sets.label.repeat(1, 2))
    p = trained(data.train_v[others].expand(3, -1, -1)).softmax(-1)
    for number in range(3):
        chosen = torch.isin(others, at[number, 20:])
        assert p[number, chosen].amax(-1).min() >= p[number, ~chosen].amax(-1).max()
        answers = dict(zip(others.tolist(), p[number].argmax(-1).tolist(), strict=True))
        assert [answers[i] for i in at[number, 20:].tolist()] == label[number, 20:].tolist()


def record(method: str, n: int, draw: int, accuracy: float, cross_validated: float = 0.5) -> Record:
    one = {"test_accuracy": accuracy, "cross_validated": cross_validated, "tried": 3.0, "labels": float(n)}
    measures = {name: [[value]] for name, value in {**one, "chosen rate": 0.1}.items()}
    return Record(method=method, labels=n, seed=draw, at=[1], seconds=[2.0], measures=measures)


CLAIMS = [
    Claim(better="{best}", than="bn", controls=["{best}_shuffled"]),
    Claim(better="{best}", than="{best}_shuffled", controls=[]),
    Claim(better="pcd", than="cd", controls=[]),
]
OF_15 = {
    "cd": [0.80, 0.82, 0.81, 0.84],
    "pcd": [0.90, 0.93, 0.91, 0.92],
    "cd_shuffled": [0.9] * 4,
    "pcd_shuffled": [0.80, 0.84, 0.80, 0.83],
    "bn": [0.70, 0.74, 0.70, 0.71],
}


def records(pcd_shuffled: Sequence[float] = OF_15["pcd_shuffled"]) -> list[Record]:
    found = [
        record(method, 15, draw, value, 0.6 if method == "pcd" else 0.5)
        for method, values in {**OF_15, "pcd_shuffled": pcd_shuffled}.items()
        for draw, value in enumerate(values)
    ]
    return [*found, record("cd", 60, 0, 0.9), record("bn", 60, 0, 0.95)]


def test_verdicts_are_paired_corrected_and_explained_by_controls() -> None:
    results = Accuracies(study(claims=CLAIMS), records())
    assert results.best(15) == "pcd"
    assert results.best(60) == "cd"
    lines = few_labels_verdicts(results)
    assert [line.claim for line in lines] == [
        "15 labels: PCD is above BN",
        "15 labels: PCD is above PCD_SHUFFLED",
        "15 labels: PCD is above CD",
        "60 labels: CD is above BN",
    ]
    pairs = [("pcd", "bn"), ("pcd", "pcd_shuffled"), ("pcd", "cd")]
    p = sorted(float(stats.ttest_rel(OF_15[a], OF_15[b]).pvalue) for a, b in pairs)
    corrected = [max(rank * value for rank, value in zip((3, 2, 1), p[: i + 1], strict=False)) for i in range(3)]
    shown = sorted(line.test.rpartition(" ")[2] for line in lines[:3])
    assert shown == sorted(f"{value:.2g}" for value in corrected)
    assert [line.verdict for line in lines] == ["holds", "holds", "holds", "does not hold"]
    assert lines[0].measured == "0.9150 against 0.7125"
    assert "one pair: no test" in lines[3].test
    assert worth_note(results) == (
        "With 15 labels the best pretraining is above BN and its shuffled; it is not with 60."
    )
    unfinished = Accuracies(study(claims=CLAIMS), unfinished_records())
    assert worth_note(unfinished) == "With no number of labels is the best pretraining above BN and its shuffled."
    unfinished = Accuracies(study(claims=CLAIMS), [one for one in unfinished_records() if one.labels == 15])
    assert (
        worth_note(unfinished) == "Whether the best pretraining is above BN and its shuffled is not measured yet."
    )
    explained = few_labels_verdicts(Accuracies(study(claims=CLAIMS), records([0.89, 0.92, 0.90, 0.92])))
    assert explained[0].verdict == "holds only without controls"
    assert explained[0].explained_by == ("PCD_SHUFFLED",)


def unfinished_records() -> list[Record]:
    return [one for one in records() if "shuffled" not in one.method]


def test_a_draw_of_which_nothing_could_be_judged_chooses_nothing() -> None:
    found = [record("cd", 15, draw, 0.5, math.nan if draw == 0 else 0.5) for draw in range(4)]
    results = Accuracies(study(claims=CLAIMS), [*found, record("pcd", 15, 0, 0.9, 0.6)])
    assert results.best(15) == "pcd"


def test_only_draws_that_both_have_are_compared() -> None:
    some = [one for one in records() if not (one.method == "bn" and one.seed == 2)]
    results = Accuracies(study(claims=CLAIMS), some)
    first, second = results.paired(15, "pcd", "bn")
    assert first.tolist() == [0.90, 0.93, 0.92]
    assert second.tolist() == [0.70, 0.74, 0.71]


def test_the_table_has_means_with_intervals_and_pretrainings() -> None:
    pretrained = Record(method="cd", data_set=PRETRAINING, seed=0, at=[5], seconds=[7.0], measures={})
    results = Accuracies(study(claims=CLAIMS), [*records(), pretrained])
    rows = few_labels_table(results)
    values = np.array(OF_15["cd"])
    half = stats.t.ppf(0.975, 3) * values.std(ddof=1) / 2
    assert rows[1] == ["15", "CD", "0.8175", f"{half:.4f}", "4", "0.5000", "rate=0.1", "3.0", "2.0"]
    assert rows[-1][:2] == ["none", "pretraining: cd"]
    assert rows[-1][-1] == "7.0"
    assert rows[6][3] == ""  # one draw
    assert set(few_labels_figures(results)) == {"few_labels"}


def test_a_record_of_other_labels_is_another_one() -> None:
    first = record("cd", 15, 0, 0.5)
    assert first.key != replace(first, labels=60).key


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"folds": 1}, "few_labels.folds = 1"),
        ({"labels": [0]}, "few_labels.labels = 0"),
        ({"labels": []}, "few_labels.labels"),
        ({"only": ["nothing"]}, "few_labels.only = 'nothing'"),
        ({"batch_sizes": [20, 5]}, "few_labels.batch_sizes"),
        ({"searches": {}}, "few_labels.methods.cd.search"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, object], said: str) -> None:
    with pytest.raises(SettingError, match=said):
        study(**settings)


def test_what_goes_on_from_another_method_asks_for_it() -> None:
    methods = dict(study().methods)
    methods["pseudo"] = Method(label="P", panel="p", search="rates", learner={}, after="bn")
    assert set(study(methods=methods, only=["pseudo", "bn"]).taken) == {"pseudo", "bn"}
    with pytest.raises(SettingError, match="It goes on from bn: name both"):
        study(methods=methods, only=["pseudo"])
