"""A LightningModule that is not ours, for the tests of callbacks."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.data import DataLoader, TensorDataset

from memcomp_lightning import rng
from memcomp_lightning.callbacks import StageProgressBar
from memcomp_lightning.data import PixelLayout
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import CD, PCD, positive_phase
from memcomp_lightning.training import Score

PREFIX = "TheirRBM"
IMAGES = rng.uniform((17, 6), generator=rng.stream(0, "data"))
"""Grey; the last of four batches holds two."""


class TheirRBM(pl.LightningModule):
    """Somebody else's module: automatic optimisation, torch's own loaders, the documented protocol."""

    def __init__(self) -> None:
        super().__init__()
        self.model = RBM(6, 5, weight_init=Normal(std=0.3))
        self.their_generator = rng.stream(1, "theirs")

    def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        v = batch[0]
        positive = positive_phase(self.model, v)
        sampler = CD(k=1)
        state = sampler.init(self.model, len(v), generator=self.their_generator)
        negative = sampler.sample(self.model, state, positive, generator=self.their_generator)
        gap = contrast(self.model, positive, negative.configurations)
        score = Score(gap.detach(), torch.tensor(3), len(v))
        return {
            "loss": gap,
            "contrast": gap.detach(),
            "positive": positive,
            "negative": negative.configurations,
            "info": {"temperature": torch.tensor(1.0)},
            "score": score,
        }

    def validation_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        return {"v": batch[0], "score": Score(torch.tensor(2.0), torch.tensor(1), len(batch[0]))}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1, momentum=0.9)


class TheirData(pl.LightningDataModule):
    pixel_layout = PixelLayout(2, 3)

    def _loader(self) -> DataLoader[Any]:
        return DataLoader(TensorDataset(IMAGES), batch_size=5)

    def train_dataloader(self) -> DataLoader[Any]:
        return self._loader()

    def val_dataloader(self) -> DataLoader[Any]:
        return self._loader()


class TheirChains(TheirRBM):
    """Two replicas with persistent chains, of which the protocol says nothing; they are in its checkpoints."""

    def __init__(self) -> None:
        super().__init__()
        self.model = RBM(6, 5, replicas=(2,), weight_init=Normal(std=0.3))
        self.chains = PCD(n_chains=4).init(self.model, 4, generator=self.their_generator)

    def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        positive = positive_phase(self.model, batch[0].expand(2, -1, -1))
        negative = PCD().sample(self.model, self.chains, positive, generator=self.their_generator)
        self.chains = negative.state
        gap = contrast(self.model, positive, negative.configurations)
        return {
            "loss": gap.sum(),
            "contrast": gap.detach(),
            "positive": positive,
            "negative": negative.configurations,
        }

    def validation_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        return {"v": batch[0].expand(2, -1, -1)}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["theirs"] = {"generator": self.their_generator.get_state(), "v": self.chains.x}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.their_generator.set_state(checkpoint["theirs"]["generator"])
        self.chains = type(self.chains)(checkpoint["theirs"]["v"])


def fit(
    folder: Path,
    callbacks: list[pl.Callback],
    logger: Any = False,
    module: pl.LightningModule | None = None,
    *,
    n_passes: int = 3,
    resume_from: Path | None = None,
) -> tuple[Any, pl.Trainer]:
    module = TheirRBM() if module is None else module
    trainer = pl.Trainer(
        max_epochs=n_passes,
        accelerator="cpu",
        logger=logger,
        callbacks=callbacks,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=any(isinstance(callback, StageProgressBar) for callback in callbacks),
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        default_root_dir=folder,
    )
    trainer.fit(module, datamodule=TheirData(), ckpt_path=resume_from, weights_only=True)
    return module, trainer


def tensorboard(folder: Path) -> TensorBoardLogger:
    return TensorBoardLogger(folder, name="", version="", default_hp_metric=False)


def blank(figure: Figure) -> NDArray[np.uint8]:
    """In place of ``rendered``, where nobody looks at the picture: drawing takes longer than these fits."""
    return np.zeros((2, 2, 3), dtype=np.uint8)


def events_in(folder: Path) -> EventAccumulator:
    sizes = {"images": 0, "scalars": 0, "histograms": 0, "tensors": 0}
    events = EventAccumulator(str(folder), size_guidance=sizes)
    events.Reload()
    return events
