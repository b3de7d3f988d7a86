"""Products of large matrices by oneDNN where it is quicker, and nowhere else; they round to float32 as before."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from memcomp_lightning import products, rng
from memcomp_lightning.data import Batches
from memcomp_lightning.likelihood import Ais
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.products import quick_products
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import ClassifierTraining, Greedy, Joint, pretrain

SGD = partial(torch.optim.SGD, lr=0.1)


def precision() -> str:
    chosen: str = torch.backends.mkldnn.matmul.fp32_precision  # type: ignore[attr-defined]
    return chosen


@pytest.fixture
def quicker(monkeypatch: pytest.MonkeyPatch) -> None:
    if not products._is_there():
        pytest.skip("torch has no oneDNN to choose")
    monkeypatch.setattr(products, "_onednn_is_quicker", lambda: True)


@pytest.mark.usefixtures("quicker")
def test_large_products_are_oneDNNs_and_small_ones_stay() -> None:  # noqa: N802
    before = precision()
    with quick_products(2**22):
        assert precision() == "bf16"
    with quick_products(2**22 - 1):
        assert precision() == before
    with pytest.raises(ZeroDivisionError), quick_products(2**22):
        _ = 1 / 0
    assert precision() == before


@pytest.mark.parametrize(
    ("name", "rounds", "there", "quicker"),
    [
        ("znver5", False, True, True),
        ("znver4", False, True, True),
        ("znver6", True, True, False),
        ("sapphirerapids", False, True, False),
        ("znver5", False, False, False),
    ],
)
def test_a_processor_is_known_by_its_name(
    monkeypatch: pytest.MonkeyPatch, name: str, rounds: bool, there: bool, quicker: bool
) -> None:
    monkeypatch.setattr(products, "get_host_cpu_name", lambda: name)
    monkeypatch.setattr(products, "multiplies_in_bfloat16", lambda: rounds)
    monkeypatch.setattr(products, "_is_there", lambda: there)
    assert products._onednn_is_quicker.__wrapped__() is quicker


def test_an_older_torch_has_nothing_to_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends, "mkldnn", SimpleNamespace(is_available=lambda: True))
    assert not products.multiplies_in_bfloat16.__wrapped__()
    assert not products._onednn_is_quicker.__wrapped__()


@pytest.mark.parametrize("shape", [(100, 784, 500), (700, 64, 128), (3, 2048, 900), (100, 1021, 101)], ids=str)
def test_what_is_quicker_here_rounds_no_more_than_before(shape: tuple[int, int, int]) -> None:
    """On any processor; where it is not taken, both are the same."""
    n, k, m = shape
    generator = rng.stream(0, "products")
    x, w = (rng.uniform(size, generator=generator) - 0.5 for size in ((n, k), (m, k)))
    exact = x.double() @ w.double().T
    found = []
    for n_multiplications in (0, 2**30):
        with quick_products(n_multiplications):
            found += [torch.nn.functional.linear(x, w), torch.bmm(x[None], w.T[None])[0]]
    errors = [float((product - exact).abs().max()) for product in found]
    assert max(errors[2:]) < 2 * max(errors[:2]) + 1e-6


def test_the_largest_layer_counts_for_each_replica() -> None:
    network = torch.nn.ParameterList([torch.empty(2**20), torch.empty(7, 5, 3), torch.empty(4, 2)])
    assert products.n_weights(network) == 15
    assert products.n_weights(torch.nn.Identity()) == 0


@pytest.mark.parametrize("training", ["pretraining", "pretraining of a machine", "fine-tuning", "likelihood"])
def test_updates_and_annealing_take_it(monkeypatch: pytest.MonkeyPatch, training: str) -> None:
    asked = []

    @contextmanager
    def watched(n: int) -> Iterator[None]:
        asked.append(n)
        yield

    for module in ("training.loops", "likelihood.ais"):
        monkeypatch.setattr(f"memcomp_lightning.{module}.quick_products", watched)
    v, label = torch.ones(6, 5), torch.zeros(6, dtype=torch.long)
    batches = Batches(v, label, 4, 6, True, 0)
    if training == "pretraining":
        list(pretrain(Greedy(DBN(5, [3])), batches, CD(), iterations=1, optimizer=SGD))
    elif training == "pretraining of a machine":  # whose couplings are a list
        list(pretrain(Joint(DBN(5, [2, 1])), batches, CD(), iterations=1, optimizer=SGD))
    elif training == "fine-tuning":
        network = torch.nn.utils.skip_init(torch.nn.Linear, 5, 3)
        ClassifierTraining(network, optimizer=SGD).run_pass(batches)
    else:
        Ais(n_chains=4, n_betas=2).estimate(RBM(5, 3), generator=rng.stream(0, "AIS"))
    assert asked
    assert asked[0] == 4 * 5 * 3
