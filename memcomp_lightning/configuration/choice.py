"""A setting whose value held-out training images choose: ``choose={setting: NAME, values: [...]}``."""

import copy
import logging
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memcomp_lightning.configuration.plans import plan_of
from memcomp_lightning.configuration.rows import HELD_OUT
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.studies import AccuracyTrial, Records, SideBySide

log = logging.getLogger(__name__)


def tried_values(config: DictConfig) -> list[float]:
    """The values that are tried, none if nothing is chosen; refuses a setting that does not exist."""
    if config.choose is None:
        return []
    allowed = "{setting: NAME, values: [...]}, or null"
    require(isinstance(config.choose, DictConfig), "choose", config.choose, allowed)
    for key in config.choose:
        require_choice("setting of choose", str(key), ("setting", "values"))
    values = config.choose.get("values")
    numbers = isinstance(values, ListConfig) and all(type(value) in (int, float) for value in values)
    require(numbers and len(values) > 0, "choose.values", values, "a list of at least one number")
    with_choice(config, values[0])
    return list(values)


def with_choice(config: DictConfig, value: float) -> DictConfig:
    """A copy in which the setting, which must exist, has this value and nothing is left to choose."""
    require(type(value) in (int, float), "value that was chosen", value, "a number: records may be a stranger's")
    chosen, setting = copy.deepcopy(config), config.choose.get("setting")
    try:
        OmegaConf.update(chosen, str(setting), value)
    except OmegaConfBaseException as error:
        raise UserError(f"choose.setting = {setting!r} is no setting of this run: {error}") from error
    chosen.choose = None
    return chosen


def for_trial(config: DictConfig, value: float) -> DictConfig:
    """A copy in which the setting has this value, and images are held out to judge it by."""
    chosen = with_choice(config, value)
    if config.data.get("validation") is None:
        chosen.data.validation_fraction = config.data.validation_fraction or HELD_OUT
    chosen.pretrain.keep_best = False  # trials train without a trainer, to the end
    return chosen


def trial_of(
    config: DictConfig, method: str, *, value: float | None = None, choosing: bool = False
) -> AccuracyTrial:
    """A training with these settings of one run, and the value of what is to be chosen; None where nothing is."""
    own = config
    if value is not None:
        own = for_trial(config, value) if choosing else with_choice(config, value)
    settings: Any = OmegaConf.to_container(own, resolve=False)
    return AccuracyTrial(
        method=method,
        settings=settings,
        build=plan_of,
        iterations=own.pretrain.iterations,
        seed=own.seed,
        value=value,
        choosing=choosing,
    )


def settle(config: DictConfig, folder: RunFolder) -> tuple[DictConfig, dict[str, object] | None]:
    """Try each value; return the settings with the best one, and what was found. Records go to ``choice.jsonl``.

    Each value trains without a trainer, on the images that are not held out, and is judged after the last pass.
    """
    values = tried_values(config)
    if not values:
        return config, None
    setting, records = config.choose.setting, Records(folder.path, "choice.jsonl")
    for number, value in enumerate(values, start=1):
        trial = trial_of(config, "choose", value=value, choosing=True)
        if trial.key not in records.keys:
            passes = (trial.settings["finetune"]["iterations"],)
            records.append(SideBySide((trial,), passes, 0).run(lambda what, n_updates: None))
            log.info(
                "Trial %d of %d: %s = %s, accuracy %.4f on held-out training images",
                *(number, len(values), setting, value, records.all[-1].held_out),
            )
    chosen = records.best_value("choose")
    assert chosen is not None
    accuracies = [record.held_out for record in records.all]
    found = {"setting": setting, "value": chosen, "values": values, "accuracies": accuracies}
    return with_choice(config, chosen), found
