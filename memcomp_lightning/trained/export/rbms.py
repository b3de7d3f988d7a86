"""HDF5 in the layout of the library rbms."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memcomp_lightning import rng
from memcomp_lightning.errors import UserError
from memcomp_lightning.files import written_whole
from memcomp_lightning.interop.rbms import BITS, Hyperparameters, rbms_form, read_rbms, write_rbms
from memcomp_lightning.models import RBM
from memcomp_lightning.trained.export.base import Written
from memcomp_lightning.trained.export.plain import N_CHECKED, compared
from memcomp_lightning.trained.run import Run

N_CHAINS = 500
"""Chains that the file holds."""


def write(run: Run, path: Path, what: str) -> Written:
    """Write an RBM of bits, spins or categories, with chains and settings: rbms loads it and trains it further."""
    rbm = run.model
    if not isinstance(rbm, RBM):
        raise UserError(f"{run.path} is a {type(rbm).__name__}: rbms has RBMs alone. Choose format=safetensors.")
    form = rbms_form(rbm)
    examples = form.rbm.chains().random(N_CHECKED, generator=rng.stream(0, "export check"))
    with written_whole(path) as partial:
        write_rbms(rbm, partial, _hyperparameters(run.settings or {}))
        check = f"free energies: {compared(form.rbm.free_energy, read_rbms(partial).free_energy, examples)}"
    n = form.parameters["vbias"].shape[0]
    inputs = f"{n} bits; of a spin 0 is -1" if form.kind == BITS else f"{n} numbers of states, from 0"
    use = f'rbms.io.load_params("{path}", 1, device, dtype)'
    return Written(f"a {form.kind} of rbms", inputs, check=check, use=use)


def _hyperparameters(settings: Mapping[str, Any]) -> Hyperparameters:
    """Those of the run's pretraining, by the names of rbms; its own where the run has none."""
    pretrain, sampler = settings.get("pretrain") or {}, settings.get("sampler") or {}
    found = {
        "batch_size": pretrain.get("batch_size"),
        "learning_rate": (pretrain.get("optimizer") or {}).get("lr"),
        "gibbs_steps": sampler.get("k"),
        "seed": settings.get("seed"),
    }
    known = {name: value for name, value in found.items() if value is not None}
    return Hyperparameters(**known, n_chains=N_CHAINS)
