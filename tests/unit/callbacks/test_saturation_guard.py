"""Training that goes out of hand stops, and the last good weights are on disk."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from foreign import TheirData, TheirRBM, fit
from lightning.pytorch.callbacks import ModelCheckpoint

from memcomp_lightning.callbacks import SaturationGuard
from memcomp_lightning.data import Batches
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.models.units import Categorical, Mixed, Spin
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import DivergedError, Greedy
from memcomp_lightning.types import Configurations

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]
QUIET = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False, "accelerator": "cpu"}


class GoesWrong(TheirRBM):
    """Something happens to its model at the beginning of a pass; keeps its weights after each pass."""

    def __init__(self, wrong: Callable[[Any], None], at: int) -> None:
        super().__init__()
        self.wrong, self.at = wrong, at
        self.after: list[dict[str, torch.Tensor]] = []

    @torch.no_grad()
    def on_train_epoch_start(self) -> None:
        if self.current_epoch >= self.at:
            self.wrong(self.model)

    def on_train_epoch_end(self) -> None:
        self.after.append({name: tensor.clone() for name, tensor in self.state_dict().items()})


def assert_holds(path: Path, weights: dict[str, torch.Tensor]) -> None:
    found = torch.load(path, weights_only=True)
    assert found.keys() == weights.keys()
    assert all(found[name].equal(weights[name]) for name in weights)
    assert not list(path.parent.glob("*.partial"))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (lambda rbm: rbm.b[2].fill_(torch.nan), r"model\.b has an entry of nan"),
        (lambda rbm: rbm.weight[1, 2].fill_(-torch.inf), r"model\.weight has an entry of (inf|nan)"),
        (lambda rbm: rbm.c[0].fill_(-300), r"model\.c has an entry of (299|300)"),
    ],
    ids=["nan", "infinite", "large"],
)
def test_a_bad_parameter_is_named_with_its_pass_and_the_last_good_weights(
    tmp_path: Path, wrong: Callable[[Any], None], named: str
) -> None:
    module = GoesWrong(wrong, at=2)
    path = tmp_path / "last_good.pt"
    said = rf"pass 3 of GoesWrong: {named}.* largest = 100\. .*after pass 2 of GoesWrong, are in {path}"
    with pytest.raises(DivergedError, match=said):
        fit(tmp_path, [SaturationGuard(largest=100)], module=module, n_passes=5)
    assert_holds(path, module.after[1])


def test_units_stuck_for_some_passes_stop_training_with_the_weights_from_before(tmp_path: Path) -> None:
    module = GoesWrong(lambda rbm: rbm.c.fill_(40), at=1)
    said = r"pass 3 of GoesWrong: 100.0% of the hidden means .* patience = 2 passes.*after pass 1 of GoesWrong"
    with pytest.raises(DivergedError, match=said):
        fit(tmp_path, [SaturationGuard(patience=2)], module=module, n_passes=5)
    assert_holds(tmp_path / "last_good.pt", module.after[0])


def test_spins_beside_categories_are_stuck_at_either_value(tmp_path: Path) -> None:
    hidden = Mixed(Spin(2), Categorical([3]))

    def stuck(field: list[float]) -> float:
        module = GoesWrong(lambda rbm: None, at=0)
        module.model = RBM(6, visible=None, hidden=hidden)
        h = hidden.mean(torch.tensor([field]))
        outputs = {"positive": Configurations(torch.zeros(1, 6), h)}
        return SaturationGuard._stuck(pl.Trainer(logger=False, barebones=True), module, outputs)

    assert stuck([-40.0, 40.0, 40.0, 0.0, 0.0]) == 1.0
    assert stuck([0.0, 40.0, 40.0, 0.0, 0.0]) == pytest.approx(0.8)
    assert stuck([0.0, 0.0, 0.0, 0.0, 0.0]) == 0.0


def test_passes_before_an_interruption_count(tmp_path: Path) -> None:
    module = GoesWrong(lambda rbm: rbm.c.fill_(40), at=1)
    _, trainer = fit(tmp_path, [SaturationGuard(patience=3)], module=module)  # two stuck passes
    trainer.save_checkpoint(tmp_path / "half.ckpt")
    resumed = GoesWrong(lambda rbm: rbm.c.fill_(40), at=1)
    guard = SaturationGuard(patience=3)
    with pytest.raises(DivergedError, match="pass 4 of"):
        fit(tmp_path, [guard], module=resumed, n_passes=9, resume_from=tmp_path / "half.ckpt")
    assert_holds(tmp_path / "last_good.pt", module.after[0])


def test_weights_go_beside_the_checkpoints_and_no_bad_checkpoint_is_written(tmp_path: Path) -> None:
    keep = ModelCheckpoint(dirpath=tmp_path / "kept", filename="last", enable_version_counter=False)
    module = GoesWrong(lambda rbm: rbm.b.fill_(torch.nan), at=2)
    trainer = pl.Trainer(max_epochs=4, callbacks=[SaturationGuard(), keep], default_root_dir=tmp_path, **QUIET)
    with pytest.raises(DivergedError, match=r"kept/last_good\.pt"):
        trainer.fit(module, datamodule=TheirData())
    assert_holds(tmp_path / "kept/last_good.pt", module.after[1])
    assert torch.load(tmp_path / "kept/last.ckpt", weights_only=True)["epoch"] == 1


def test_a_module_that_stops_itself_leaves_its_good_weights_too(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    module = EnergyPretraining(
        Greedy(DBN(4, [3])), CD(), iterations=5, optimizer=partial(torch.optim.SGD, lr=1e38), seed=0
    )
    initial = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    trainer = pl.Trainer(
        max_epochs=5,
        callbacks=[SaturationGuard()],
        default_root_dir=tmp_path,
        enable_checkpointing=False,
        limit_val_batches=0,
        **QUIET,
    )
    images = Batches(torch.eye(4), torch.zeros(4).long(), None, 10, True, 0)
    with pytest.raises(DivergedError, match=r"Lower the learning rate \(pretrain"):
        trainer.fit(module, images, images)
    assert_holds(tmp_path / "last_good.pt", initial)
    assert "from before pass 1 of pretrain/layer1" in caplog.text


def test_bad_weights_from_the_start_are_said_to_be_so(tmp_path: Path) -> None:
    module = TheirRBM()
    with torch.no_grad():
        module.model.b.fill_(torch.nan)
    with pytest.raises(DivergedError, match="no good weights to go back to"):
        fit(tmp_path, [SaturationGuard()], module=module)
    assert not (tmp_path / "last_good.pt").exists()


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingError, match="largest = 0"):
        SaturationGuard(largest=0)
    with pytest.raises(SettingError, match="patience = 0"):
        SaturationGuard(patience=0)
