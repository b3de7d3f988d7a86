import importlib
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from hydra import compose
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.configuration import values
from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.configuration.values import check_kinds
from memcomp_lightning.errors import SettingError

CONF = Path(__file__).parents[3] / "conf"
GROUPS = {
    group: [f"{group}={path.stem}" for path in sorted((CONF / group).glob("*.yaml"))]
    for group in ("sampler", "solver", "positive", "pretrain", "model", "data", "units")
}
SAMPLERS, *OTHERS = GROUPS.values()
# Each option once, those of several groups side by side: to compose takes most of the time. Samplers set solvers.
TOGETHER = [(option,) for option in SAMPLERS]
TOGETHER += [tuple(filter(None, options)) for options in itertools.zip_longest(*OTHERS)]
NUMBER_OR_WORD = {"sampler.beta"}


def composed(*overrides: str) -> DictConfig:
    with composing():
        return compose("config", list(overrides))


def numbers(settings: DictConfig, name: str = "") -> Iterator[str]:
    """Names of the numbers that our own constructors take."""
    ours = str(settings.get("_target_")).startswith("memcomp_lightning.")
    for key in settings:
        if OmegaConf.is_interpolation(settings, key):
            continue
        full_name, value = f"{name}.{key}".lstrip("."), settings[key]
        if isinstance(value, DictConfig):
            yield from numbers(value, full_name)
        elif ours and isinstance(value, int | float) and not isinstance(value, bool):
            yield full_name


@pytest.mark.parametrize("options", [(), *TOGETHER], ids=",".join)
def test_words_and_lists_in_place_of_every_number(options: tuple[str, ...]) -> None:
    """Of options, those that they bring; of none, all that there are."""
    config = composed(*options)
    check_kinds(config)
    found = set(numbers(config)) - NUMBER_OR_WORD
    assert found
    groups = {option.partition("=")[0] for option in options}
    chosen = {name for name in found if not groups or name.partition(".")[0] in groups}
    for name in chosen:
        group, number = name.partition(".")[0], OmegaConf.select(config, name)
        for wrong, shown in (("oops", "'oops'"), ([1], "[1]"), (True, "True")):
            OmegaConf.update(config, name, wrong)
            with pytest.raises(SettingError, match=re.escape(f"{name} = {shown} is not allowed: expected")):
                check_kinds(*((config[group], group) if groups else (config,)))
        OmegaConf.update(config, name, number)
    check_kinds(config)


def test_a_package_that_was_missing_once_is_looked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    config = composed("sampler=annealer")
    config.sampler.rate = "oops"
    values._annotations.cache_clear()
    with monkeypatch.context() as absent:
        absent.setattr(values, "import_module", lambda name: importlib.import_module("not_installed"))
        check_kinds(config)
    with pytest.raises(SettingError):
        check_kinds(config)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("solver.integrator=euler", "solver.integrator = 'euler' is not allowed: expected settings by name"),
        (
            "solver.record=3",
            "solver.record = 3 is not allowed: expected settings by name with a _target_, or null",
        ),
        ("model.hidden_sizes=wide", "model.hidden_sizes = 'wide' is not allowed: expected a list"),
        ("data.source.split_seed=a", "data.source.split_seed = 'a' is not allowed: expected an integer"),
        ("finetune.optimizer.lr={a: 1}", "finetune.optimizer.lr = {'a': 1} is not allowed: expected a number"),
        (
            "trainer.log_every_n_steps=often",
            "trainer.log_every_n_steps = 'often' is not allowed: expected an integer",
        ),
        ("+trainer.deterministic=[1]", "trainer.deterministic = [1] is not allowed: expected true or false"),
    ],
)
def test_other_kinds(override: str, message: str) -> None:
    with pytest.raises(SettingError, match=re.escape(message)):
        check_kinds(composed(override))


@pytest.mark.parametrize(
    "override",
    [
        "pretrain.optimizer.lr=1",
        "solver.integrator={_target_: memcomp_lightning.solvers.dmm.Splitting}",
        "solver.max_steps=null",
        "data.source.threshold=0",
        "+trainer.devices=[0]",
        "trainer.fast_dev_run=2",
        "sampler._target_=tests.their.Own",
    ],
)
def test_what_fits(override: str) -> None:
    check_kinds(composed(override))
