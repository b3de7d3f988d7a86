"""``experiment=sampler_worth``: energy models trained by many samplers, measured by likelihood on the way."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.configuration.composition import (
    check_not_given,
    composed_for,
    settings_of_comparison,
)
from memcomp_lightning.configuration.plans import build, check_without_trainer, plan_of
from memcomp_lightning.configuration.values import filled
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.files import write_json
from memcomp_lightning.models import joint_model, stacked
from memcomp_lightning.studies import LikelihoodTrial, Records, runner
from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.plan import images_of, pretraining_of
from memcomp_lightning.studies.worth import Comparison, Method

_SET_BY_COMPARISON = {
    "pretrain.iterations": "Use worth.data_sets.NAME.passes.",
    "sampler": "Each of worth.methods has its own.",
}


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build one replica of every method on every data set, and train nothing; raises as ``build``."""
    if config.figure is not None:
        raise UserError(
            "preset=quick is one of figures: make the comparison smaller with worth.only=[DATA_SET], "
            "worth.replicas=N or worth.methods.NAME.rates=[...]."
        )
    check_not_given(overrides, _SET_BY_COMPARISON, "a comparison")
    comparison = filled(Comparison, config.worth, "worth")
    require_choice("trainer.accelerator", config.trainer.accelerator, ("auto", "cpu"))
    seen: set[tuple[str, str]] = set()
    for trial in _trials(comparison, overrides, Path()):
        own = OmegaConf.create(trial.settings)
        plan = build(own)
        check_without_trainer(plan, own)
        data = images_of(pretraining_of(plan)[0])
        require(data.replicas == (), "data.partitions", data.replicas, "1: replicas are seeds here")
        if (trial.data_set, trial.method) not in seen:
            seen.add((trial.data_set, trial.method))
            measure = MEASURES[comparison.data_sets[trial.data_set].measure]
            score = measure.make(data, 1)
            if measure.is_exact:
                score(joint_model(stacked([plan.network], ())))


def train(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Train what is missing; each record is written when it exists."""
    comparison, records = filled(Comparison, config.worth, "worth"), Records(folder)
    write_json(folder / "worth.json", asdict(comparison))
    (folder / "weights").mkdir(exist_ok=True)
    done = records.keys
    missing = [trial for trial in _trials(comparison, overrides, folder) if trial.key not in done]
    with runner(comparison.name, workers=comparison.workers) as run:
        run(missing, records)


def _trials(comparison: Comparison, overrides: Sequence[str], folder: Path) -> Iterator[LikelihoodTrial]:
    for data_name in comparison.only or comparison.data_sets:
        data_set = comparison.data_sets[data_name]
        for method_name in data_set.methods or comparison.methods:
            method = comparison.methods[method_name]
            passes = max(1, round(data_set.passes * method.longer))
            own_overrides = (*method.overrides, *data_set.overrides)
            usual = composed_for(overrides, (*own_overrides, *settings_of_comparison(passes)))
            iterations, greedy_passes, all_passes = _schedule(usual, passes, method)
            composed = composed_for(overrides, (*own_overrides, *settings_of_comparison(iterations)))
            for rate in data_set.rates or method.rates or comparison.rates:
                own: Any = OmegaConf.to_container(composed, resolve=False)
                own["pretrain"] = {**own["pretrain"], "optimizer": {**own["pretrain"]["optimizer"], "lr": rate}}
                yield LikelihoodTrial(
                    data_set=data_name,
                    method=method_name,
                    value=rate,
                    comparison=comparison,
                    folder=str(folder),
                    settings=own,
                    build=plan_of,
                    points=_points(all_passes, data_set.points or comparison.points),
                    greedy_passes=greedy_passes,
                )


def _schedule(composed: DictConfig, passes: int, method: Method) -> tuple[int, int, int]:
    """Share passes out to layers, so that methods of many layers and of one have about as many updates.

    These are passes of a layer or of all layers together, of each layer before joint training, and in all.
    """
    n_phases, layers = len(pretraining_of(build(composed))[1].phases), len(composed.model.get("hidden_sizes", [0]))
    if n_phases > 1 or not method.greedy_start:
        each = max(1, passes // n_phases)
        return each, 0, each * n_phases
    greedy = round(passes * method.greedy_start / layers)
    joint = max(1, passes - greedy * layers)
    return joint, greedy, greedy * layers + joint


def _points(passes: int, n: int) -> tuple[int, ...]:
    """Passes that are about evenly spaced in the logarithm, the last one included."""
    spaced = [round(passes ** (k / (n - 1))) for k in range(n)] if n > 1 else [passes]
    return tuple(dict.fromkeys(spaced))
