"""Handwritten digits of scikit-learn, as plain tensors."""

import lightning.pytorch as pl
import torch
from sklearn.datasets import load_digits
from torch import Tensor
from torch.utils.data import DataLoader, TensorDataset

from memcomp_lightning import rng


class DigitImages(pl.LightningDataModule):
    """1,500 images of 8 x 8 pixels to train on, 297 held out.

    Args:
        batch_size: Images an update.
        seed: Of their order.
    """

    n_visible = 64

    def __init__(self, batch_size: int, seed: int) -> None:
        super().__init__()
        pixels = load_digits(return_X_y=True)[0]
        self.images = torch.as_tensor(pixels, dtype=torch.float32) / 16
        self.batch_size = batch_size
        self.generator = rng.stream(seed, "data_order")

    def train_dataloader(self) -> DataLoader[tuple[Tensor, ...]]:
        """Shuffled."""
        images = TensorDataset(self.images[:1500])
        return DataLoader(images, batch_size=self.batch_size, shuffle=True, generator=self.generator)

    def val_dataloader(self) -> DataLoader[tuple[Tensor, ...]]:
        """In one batch."""
        return DataLoader(TensorDataset(self.images[1500:]), batch_size=297)
