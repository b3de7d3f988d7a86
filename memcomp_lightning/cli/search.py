"""Multiruns before they start: which jobs there will be, and whether their sweeper can search."""

import re
from collections.abc import Sequence

from hydra import compose
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.configuration.composition import study_of
from memcomp_lightning.configuration.values import require_held_out
from memcomp_lightning.errors import UserError, require


def planned_jobs(overrides: Sequence[str], *, config_name: str) -> tuple[list[list[str]], bool, str | None]:
    """Jobs that a multirun will do, whether its sweeper searches, and its folder if that is named by the time.

    A search (``hydra/sweeper=optuna``) decides on its jobs by what earlier ones returned. In their place stand
    those in which one setting after the other takes each of its choices, or the ends of its interval.
    """
    parsed = _parsed(overrides)
    _check_not_empty(parsed)
    # Other settings may need a group that is swept: sampler.k of sampler=cd,pcd.
    of_sweeper = [o.input_line or "" for o in parsed if o.is_hydra_override() or o.key_or_group == "hparams"]
    hydra = compose(config_name, of_sweeper, return_hydra_config=True).hydra
    sweeper, folder = hydra.sweeper, named_by_time(hydra.sweep)
    _check_storage(sweeper.get("storage"))
    of_params = _parsed([f"{key}={value}" for key, value in (sweeper.params or {}).items()])
    settings = {override.get_key_element(): override for override in [*of_params, *parsed]}
    if sweeper._target_.endswith(f".{BasicSweeper.__name__}"):
        (jobs,) = BasicSweeper.split_arguments(list(settings.values()), None)
        return jobs, False, folder
    values = [_values(override) for override in settings.values()]
    first = [options[0] for options in values]
    others = [
        [*first[:position], option, *first[position + 1 :]]
        for position, options in enumerate(values)
        for option in options[1:]
    ]
    return [first, *others], True, folder


def named_by_time(settings: DictConfig) -> str | None:
    """The folder of a run or of a sweep, if its name has no other variables than the time; else None."""
    name = OmegaConf.to_container(settings, resolve=False)["dir"]  # type: ignore[call-overload, index]
    return str(settings.dir) if set(re.findall(r"\$\{([^:}]*)", str(name))) == {"now"} else None


def check_searchable(config: DictConfig) -> None:
    """Refuse a job that returns nothing to search by."""
    is_one = study_of(config) is None
    require(is_one, "experiment", "one of many runs", "one run in a search")
    require_held_out(config, "in a search", "settings")
    n_passes = config.finetune.iterations
    require(n_passes > 0, "finetune.iterations", n_passes, "an integer >= 1 in a search, which goes by accuracy")


def _check_not_empty(overrides: Sequence[Override]) -> None:
    """Refuse a sweep over nothing, which Hydra would do at once, and call done."""
    for override in overrides:
        if not override.is_discrete_sweep() or list(override.sweep_string_iterator()):
            continue
        known = []
        if isinstance(override.value(), Glob):
            known = GlobalHydra.instance().config_loader().get_group_options(override.key_or_group)
            if not known:
                raise UserError(
                    f"{override.input_line}: glob() chooses among the options of a group, and "
                    f"{override.key_or_group} is none. Name the values: {override.key_or_group}=1,2"
                )
        options = f" Known here: {', '.join(known)}." if known else ""
        raise UserError(f"{override.input_line} matches nothing: no job would be done.{options}")


def _check_storage(storage: object) -> None:
    """Refuse what would end in an AssertionError inside optuna."""
    if storage is None:
        return
    from importlib.metadata import version  # which few commands need

    optuna, sqlalchemy = version("optuna"), version("sqlalchemy")
    if int(optuna.partition(".")[0]) < 3 and int(sqlalchemy.partition(".")[0]) >= 2:
        raise UserError(
            f"hydra.sweeper.storage = {storage!r} is not allowed: optuna {optuna} cannot use SQLAlchemy "
            f"{sqlalchemy}. Leave it null: with hydra.sweep.dir=FOLDER the same command goes on from the jobs in "
            "that folder. Or take Hydra 1.4 with hydra-optuna-sweeper 1.4."
        )


def _parsed(overrides: Sequence[str]) -> list[Override]:
    loader = GlobalHydra.instance().config_loader()  # for glob(...), which lists options
    return OverridesParser.create(config_loader=loader).parse_overrides(list(overrides))


def _values(override: Override) -> list[str]:
    key = override.get_key_element()
    if override.is_interval_sweep():
        interval = override.value()
        return [f"{key}={end}" for end in (interval.start, interval.end)]  # type: ignore[union-attr]
    if override.is_sweep_override():
        return [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [override.input_line or ""]
