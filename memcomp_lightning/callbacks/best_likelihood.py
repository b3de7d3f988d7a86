"""Early stopping of an energy model: the weights at which held-out rows were most likely."""

from typing import Any, ClassVar, cast

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from memcomp_lightning.callbacks.base import iteration_of
from memcomp_lightning.callbacks.log_likelihood import LogLikelihood
from memcomp_lightning.training.best import BestPass


class BestLikelihood(LogLikelihood):
    """Logs what :class:`LogLikelihood` logs, and keeps the weights at which held-out rows were most likely.

    Each model in turn ends with the weights of its best look, each replica with its own. Of equal looks the first
    stays. Where there is no likelihood (a model too large for ``method="auto"``, missing values that are not
    summed) the newest weights stay, and a line says so. Checkpoints hold the weights kept so far.

    Args:
        every: As of ``LogLikelihood``; None means about twenty looks a model.
        patience: Looks without a better one after which the training of a model ends, >= 1; None trains to the
            end.
        settings: Those of ``LogLikelihood``.
    """

    changes_training = True
    looks_a_stage: ClassVar[int] = 20

    def __init__(self, every: int | None = None, *, patience: int | None = None, **settings: Any) -> None:
        super().__init__(every, **settings)
        self.patience = patience
        self._layer = 0
        self._best = BestPass(patience=patience)

    def on_train_epoch_start(self, *arguments: object) -> None:
        """Put the best weights of a model back before the next one begins."""
        super().on_train_epoch_start()
        pl_module = cast(pl.LightningModule, arguments[1])
        if (layer := int(getattr(pl_module, "layer", 0))) != self._layer:
            self._put_back(pl_module)
            self._layer, self._best = layer, BestPass(patience=self.patience)

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Measure; keep the weights of the replicas that are better than ever."""
        super().look(trainer, pl_module, outputs)
        newest = self.history[-1] if self.history else None
        present = (self._layer, iteration_of(pl_module) + 1)
        if newest is None or (newest["layer"], newest["iteration"]) != present or not newest["heldout"]:
            self.leave_out("there is no likelihood of held-out rows to choose by, and the newest weights stay")
            return
        model = self._model_of(pl_module)
        value = torch.tensor(newest["heldout"], dtype=torch.float64).view(getattr(model, "replicas", ()))
        if newest["gap"] and newest["method"] == "ais":
            # Of both estimates of log Z the larger one counts, which flatters no model.
            value += torch.tensor(newest["gap"], dtype=torch.float64).view_as(value).clamp_max(0.0)
        # Processes have estimates of their own; every one must come to the same weights.
        shared = trainer.strategy.reduce(value.to(pl_module.device, torch.float32), reduce_op="mean")
        self._best.offer(cast(Tensor, shared), model.state_dict())
        if self._best.over:
            trainer.should_stop = True

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put the best weights of the last model back."""
        self._put_back(pl_module)

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put them back, too, if a resumed run had nothing left to train."""
        self._put_back(pl_module)

    def _put_back(self, module: pl.LightningModule) -> None:
        if self._best.weights:
            self._model_of(module).load_state_dict(self._best.weights)

    def _model_of(self, module: pl.LightningModule) -> nn.Module:
        models = getattr(module, "models", None)
        model: Any = module.model if models is None else models[self._layer]
        assert isinstance(model, nn.Module)
        return model

    def state_dict(self) -> dict[str, Any]:
        """The values so far, and what is kept of the model in training."""
        return {**super().state_dict(), "layer": self._layer, "best": self._best.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self._layer = int(state_dict["layer"])
        self._best.load_state_dict(state_dict["best"])
