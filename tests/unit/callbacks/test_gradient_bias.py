"""The bias of a sampler's gradient, against gradients of the enumerated likelihood."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from foreign import TheirChains, TheirRBM, fit

from memcomp_lightning.callbacks import GradientBias
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import Exact, positive_phase
from memcomp_lightning.types import NoState

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]


class Remembers(TheirChains):
    """Keeps parameters and phases of its last step."""

    def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        self.before = {name: tensor.detach().clone() for name, tensor in self.model.named_parameters()}
        self.outputs = super().training_step(batch, batch_idx)
        return self.outputs


def test_values_are_those_of_the_enumerated_likelihood_at_the_parameters_of_the_step(tmp_path: Path) -> None:
    module, trainer = fit(tmp_path, [GradientBias(every=2)], module=Remembers())
    cosines, errors = [], []
    positive, negative = module.outputs["positive"], module.outputs["negative"]
    for replica in range(2):
        rbm = RBM(6, 5)
        rbm.load_state_dict({name: tensor[replica] for name, tensor in module.before.items()})
        v, h = negative.v[replica], negative.h[replica]
        found = rbm.free_energy(positive.v[replica]).mean() - rbm.energy(v, h).mean()
        log_z = (-rbm.free_energy(binary_states(6, like=rbm.b))).logsumexp(-1)
        wanted = rbm.free_energy(positive.v[replica]).mean() + log_z
        g, w = (
            torch.cat([part.flatten() for part in torch.autograd.grad(loss, list(rbm.parameters()))])
            for loss in (found, wanted)
        )
        cosines.append(float(g @ w / (g.norm() * w.norm())))
        errors.append(float((g - w).norm() / w.norm()))
    logged = trainer.callback_metrics
    prefix = "Remembers/gradient_bias"
    assert logged[f"{prefix}/cosine"] == pytest.approx(sum(cosines) / 2, rel=1e-4)
    assert logged[f"{prefix}/relative_error"] == pytest.approx(sum(errors) / 2, rel=1e-4)
    assert cosines[0] < 0.999


def test_the_exact_sampler_has_none(tmp_path: Path) -> None:
    class TheirExact(TheirRBM):
        def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
            positive = positive_phase(self.model, batch[0])
            negative = Exact().sample(self.model, NoState(), positive, generator=self.their_generator)
            loss = contrast(self.model, positive, negative.configurations)
            return {"loss": loss, "positive": positive, "negative": negative.configurations}

    _, trainer = fit(tmp_path, [GradientBias(every=1)], module=TheirExact())
    assert trainer.callback_metrics["TheirExact/gradient_bias/cosine"] == pytest.approx(1, abs=1e-5)
    assert trainer.callback_metrics["TheirExact/gradient_bias/relative_error"] < 1e-5


def test_the_models_own_gradients_stay_as_they_are(tmp_path: Path) -> None:
    class SetsGradients(pl.Callback):
        def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            for parameter in pl_module.parameters():
                parameter.grad = torch.ones_like(parameter)

    class ChecksGradients(pl.Callback):
        n_passes = 0

        def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            assert all(bool((parameter.grad == 1).all()) for parameter in pl_module.parameters())
            self.n_passes += 1

    checks = ChecksGradients()
    fit(tmp_path, [SetsGradients(), GradientBias(every=1), checks])
    assert checks.n_passes == 3


def test_layers_too_large_to_enumerate_are_refused_before_training(tmp_path: Path) -> None:
    module = TheirRBM()
    module.model = RBM(17, 18, weight_init=Normal(std=0.3))
    with pytest.raises(
        SettingError, match=r"units to enumerate for GradientBias = 17 .* at most 16 .*Leave GradientBias"
    ):
        fit(tmp_path, [GradientBias()], module=module)
