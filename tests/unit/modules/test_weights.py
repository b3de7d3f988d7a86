"""Weights go into the model they belong to, and into no other."""

from pathlib import Path
from typing import Any

import pytest
import torch

from memcomp_lightning.models import DBM, DBN, RBM, BatchNormReluNetwork, BoltzmannMachine, Normal
from memcomp_lightning.models.connectivity import full
from memcomp_lightning.modules import CheckpointError, DBNClassifier, load_weights, save_weights
from memcomp_lightning.modules.weights import check_checkpoint

RING = [(0, 1), (1, 2), (2, 3), (0, 3)]
STAR = [(0, 1), (0, 2), (0, 3), (1, 2)]


def machine(pairs: Any, **settings: Any) -> BoltzmannMachine:
    return BoltzmannMachine(3, 1, pairs, weight_init=Normal(std=0.5), **settings)


def without_pairs(state: dict[str, Any]) -> dict[str, Any]:
    """As version 0.1 wrote them."""
    return {name: tensor for name, tensor in state.items() if not name.endswith("pairs")}


def test_couplings_of_other_pairs_are_refused(tmp_path: Path) -> None:
    """As many of them, so that all shapes agree."""
    save_weights(machine(RING), tmp_path / "ring.pt")
    with pytest.raises(
        CheckpointError, match=r"ring\.pt: .* other pairs of units: \(0, 2\) is coupled in this machine"
    ):
        load_weights(machine(STAR), tmp_path / "ring.pt")
    with pytest.raises(RuntimeError, match="other pairs of units"):
        machine(STAR).load_state_dict(machine(RING).state_dict())
    with pytest.raises(RuntimeError, match="other pairs of units"):
        DBM(2, [3, 3]).load_state_dict(DBM(2, [5, 1]).state_dict())


def test_couplings_of_the_same_pairs_are_loaded(tmp_path: Path) -> None:
    trained = machine(RING, replicas=(2,))
    save_weights(trained, tmp_path / "ring.pt")
    model = BoltzmannMachine(3, 1, [(3, 2), (3, 0), (1, 0), (2, 1)], replicas=(2,))
    load_weights(model, tmp_path / "ring.pt")
    torch.testing.assert_close(model.state_dict(), trained.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize(
    "make", [lambda: BoltzmannMachine(3, 2), lambda: DBM(5, [4, 3]), lambda: machine(full(4))]
)
def test_a_file_without_pairs_is_loaded_where_it_can_mean_one_thing(tmp_path: Path, make: Any) -> None:
    trained, model = make(), make()
    with torch.no_grad():
        trained.b.fill_(0.25)
    torch.save(without_pairs(trained.state_dict()), tmp_path / "old.pt")
    load_weights(model, tmp_path / "old.pt")
    torch.testing.assert_close(model.state_dict(), trained.state_dict(), rtol=0, atol=0)


def test_a_file_without_pairs_is_refused_where_it_can_mean_several(tmp_path: Path) -> None:
    torch.save(without_pairs(machine(RING).state_dict()), tmp_path / "old.pt")
    with pytest.raises(CheckpointError, match="the file does not hold them"):
        load_weights(machine(RING), tmp_path / "old.pt")


def changed(model: Any, name: str, value: Any) -> dict[str, Any]:
    return {**model.state_dict(), name: value}


def classifier(units: Any) -> Any:
    return DBNClassifier(DBN(5, [3]), n_classes=2, units=units).network


@pytest.mark.parametrize(
    ("content", "model", "message"),
    [
        (RBM(5, 3).state_dict(), RBM(3, 5), "weight has shape"),
        (RBM(5, 3, replicas=(2,)).state_dict(), RBM(5, 3), "weight has shape"),
        (RBM(5, 3).state_dict(), RBM(5, 3, replicas=(1,)), "weight has shape"),
        (DBN(5, [3]).state_dict(), DBM(5, [3]), "it is of another kind of model"),
        (DBM(5, [3]).state_dict(), DBN(5, [3]), "it is of another kind of model"),
        (classifier("sigmoid").state_dict(), classifier("batch_norm_relu"), "it is of another kind of model"),
        (classifier("batch_norm_relu").state_dict(), BatchNormReluNetwork(5, [3], 2), "of another kind of model"),
        (classifier("sigmoid").state_dict(), DBN(5, [3]), "it is of another kind of model"),
        (DBN(5, [3, 2]).state_dict(), DBN(5, [3]), "that this model does not have"),
        (RBM(5, 3).double().state_dict(), RBM(5, 3), "is float64, which float32, .* cannot hold"),
        (RBM(5, 3).bfloat16().state_dict(), RBM(5, 3).half(), "is bfloat16, which float16"),
        (changed(RBM(5, 3), "b", torch.zeros(5, dtype=torch.int64)), RBM(5, 3), "b is int64"),
        (changed(RBM(5, 3), "b", [0.0] * 5), RBM(5, 3), "b is a list, expected a tensor"),
        (changed(RBM(5, 3), "c", torch.full((3,), torch.nan)), RBM(5, 3), "c has an entry that is NaN or"),
        (changed(RBM(5, 3), "c", torch.full((3,), -torch.inf)), RBM(5, 3), "c has an entry that is NaN or"),
        ({"state_dict": RBM(5, 3).state_dict(), "process_states": []}, RBM(5, 3), "is one of a stage in training"),
    ],
)  # fmt: skip
def test_weights_of_another_model_are_refused(tmp_path: Path, content: Any, model: Any, message: str) -> None:
    torch.save(content, tmp_path / "w.pt")
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    with pytest.raises(CheckpointError, match=rf"w\.pt.*{message}"):
        load_weights(model, tmp_path / "w.pt")
    torch.testing.assert_close(model.state_dict(), before, rtol=0, atol=0)


def test_weights_of_a_smaller_dtype_are_exact(tmp_path: Path) -> None:
    trained = RBM(5, 3, weight_init=Normal(std=0.3))
    save_weights(trained, tmp_path / "w.pt")
    model = RBM(5, 3).double()
    load_weights(model, tmp_path / "w.pt")
    torch.testing.assert_close(model.weight, trained.weight.double(), rtol=0, atol=0)


def test_a_weight_file_is_no_checkpoint_of_a_stage(tmp_path: Path) -> None:
    save_weights(RBM(5, 3), tmp_path / "last.ckpt")
    with pytest.raises(CheckpointError, match="is no checkpoint of a stage in training: delete it"):
        check_checkpoint(RBM(5, 3), tmp_path / "last.ckpt")
