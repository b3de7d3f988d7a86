"""A setting whose value held-out training images choose: ``choose={setting: NAME, values: [...]}``."""

import copy
import json
import logging
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memcomp_lightning.cli.build import plan_of
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.files import write_text
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.studies.accuracy import Member, Unit, run_unit

HELD_OUT = 0.1
"""Share of the training images that judge, unless ``data.validation_fraction`` sets one."""

log = logging.getLogger(__name__)


def tried_values(config: DictConfig) -> list[float]:
    """The values that are tried, none if nothing is chosen.

    Raises:
        SettingError: The setting does not exist, or there is no value to try.
    """
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
    """A copy in which the setting has this value and nothing is left to choose.

    Raises:
        UserError: The setting does not exist.
    """
    chosen, setting = copy.deepcopy(config), config.choose.get("setting")
    try:
        OmegaConf.update(chosen, str(setting), value)
    except OmegaConfBaseException as error:
        raise UserError(f"choose.setting = {setting!r} is no setting of this run: {error}") from error
    chosen.choose = None
    return chosen


def for_trial(config: DictConfig, value: float) -> DictConfig:
    """The same with images held out to judge the value by."""
    chosen = with_choice(config, value)
    chosen.data.validation_fraction = config.data.validation_fraction or HELD_OUT
    return chosen


def settle(config: DictConfig, folder: RunFolder) -> tuple[DictConfig, dict[str, Any] | None]:
    """Try each value, and return the settings with the best one, and what was found; written to ``choice.json``.

    Each value trains without a trainer, on the images that are not held out, and is judged after the last pass.
    """
    values = tried_values(config)
    if not values:
        return config, None
    path = folder.path / "choice.json"
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        return with_choice(config, found["value"]), found
    accuracies = []
    for number, value in enumerate(values, start=1):
        trial = for_trial(config, value)
        plain: Any = OmegaConf.to_container(trial, resolve=False)
        member = Member("choose", plain, plan_of, trial.pretrain.iterations, trial.seed, value, choosing=True)
        (record,) = run_unit(Unit((member,), (trial.finetune.iterations,), 0), lambda what, n_updates: None)
        accuracies.append(float(record.score("validation_accuracy").mean()))
        log.info(
            "Trial %d of %d: %s = %s, accuracy %.4f on held-out training images",
            *(number, len(values), config.choose.setting, value, accuracies[-1]),
        )
    best = values[accuracies.index(max(accuracies))]
    found = {"setting": config.choose.setting, "value": best, "values": values, "accuracies": accuracies}
    write_text(path, json.dumps(found, indent=1) + "\n")
    return with_choice(config, best), found
