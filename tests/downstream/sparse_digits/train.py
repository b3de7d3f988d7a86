"""``sparse-digits``: train one RBM."""

from typing import Any

import hydra
import lightning.pytorch as pl
from hydra.utils import instantiate
from omegaconf import DictConfig

from sparse_digits.data import DigitImages

TRUSTED = ("sparse_digits.*", "memcomp_lightning.*", "lightning.*")

# Hydra 1.4 wants to know which targets a configuration may name; 1.3 wants its own version.
IS_1_3 = hydra.__version__.startswith("1.3.")
SETTINGS: dict[str, Any] = {"version_base": "1.3"} if IS_1_3 else {"execution_whitelist": TRUSTED}


@hydra.main(config_path="pkg://sparse_digits.conf", config_name="config", **SETTINGS)
def main(config: DictConfig) -> float:
    """Train; return how well held-out images are told from training images, in nats."""
    data = DigitImages(config.batch_size, config.seed)
    module = instantiate(
        config.module, n_visible=data.n_visible, sampler=instantiate(config.sampler), seed=config.seed
    )
    trainer: pl.Trainer = instantiate(
        config.trainer,
        max_epochs=config.max_epochs,
        callbacks=[instantiate(callback) for callback in config.callbacks.pretrain.values()],
        logger=[instantiate(logger) for logger in config.logger.values()],
    )
    trainer.fit(module, datamodule=data)
    gap = float(trainer.callback_metrics["SparseRBM/free_energy_gap"])
    print(f"{type(module.sampler).__name__}: sparsity {trainer.callback_metrics['sparsity']:.3f}, gap {gap:.3f}")
    return gap


if __name__ == "__main__":
    main()
