"""``experiment=few_labels``: classifiers from few labels, by pretrained networks and by what else there is."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.configuration.composition import check_not_given, composed_for
from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.plans import build, check_without_trainer, plan_of
from memcomp_lightning.configuration.values import filled
from memcomp_lightning.data.labels import n_labels
from memcomp_lightning.errors import UserError, require, require_choice, require_parts
from memcomp_lightning.files import write_json
from memcomp_lightning.studies import Plan, Record, Records, runner
from memcomp_lightning.studies.few_labels import FewLabels, LabelsTrial, PretrainingTrial
from memcomp_lightning.studies.few_labels.learner import weight_file
from memcomp_lightning.studies.few_labels.trial import PRETRAINING, chosen_of, dbn_of
from memcomp_lightning.studies.plan import images_of, pretraining_of, require_bits

_SET_BY_STUDY = {
    "finetune": "Use few_labels.updates, few_labels.passes and few_labels.searches.",
    "finetune.labels": "Use few_labels.labels.",
    "finetune.iterations": "Use few_labels.updates and few_labels.passes.",
    "sampler": "Each of few_labels.pretraining has its own.",
    "control": "The controls are methods: few_labels.methods.",
    "seed": "Use few_labels.draws and few_labels.pretrainings.",
}


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build every pretraining and every method, and train nothing; raises as ``build``."""
    check_not_given(overrides, _SET_BY_STUDY, "a study of few labels")
    study = _read(config)
    require_choice("trainer.accelerator", config.trainer.accelerator, ("auto", "cpu"))
    _check_data(study, build(OmegaConf.create(_settings(study, overrides))))
    for trial in _pretrainings(study, overrides, Path()):
        if trial.seed:
            continue  # as the first one
        own = OmegaConf.create(trial.settings)
        plan = build(own)
        check_without_trainer(plan, own)
        dbn_of(plan)
        if trial.way is not None:
            require_parts(
                f"few_labels.pretraining.{trial.method}.way", trial.way, "way of pretraining", ("train",)
            )
    for name in study.taken:
        require_parts(f"few_labels.methods.{name}.learner", _learner(study, name), "way to learn", ("learn",))


def train(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Pretrain, learn from labels, and go on from that; each weight file and record is written when it exists."""
    study, records = _read(config), Records(folder)
    write_json(folder / "few_labels.json", asdict(study))
    with runner(study.name, workers=study.workers) as run:
        done = records.keys
        missing = [
            trial
            for trial in _pretrainings(study, overrides, folder)
            if trial.key not in done or not weight_file(folder, trial.method, trial.seed or 0).is_file()
        ]
        run(missing, records)
        while work := list(_missing(study, overrides, folder, records.all)):
            run(work, records)


def _read(config: DictConfig) -> FewLabels:
    if config.figure is not None:
        raise UserError("preset=quick is one of figures: type few_labels.draws=2, few_labels.labels=[100].")
    return filled(FewLabels, config.few_labels, "few_labels")


def _check_data(study: FewLabels, plan: Plan) -> None:
    data = images_of(pretraining_of(plan)[0])
    require_bits(data, "draws")
    share = len(data.heldout[0]) / (len(data.heldout[0]) + data.n_train)
    require(not data.holds_out, "data.validation_fraction", share, "0: cross-validation takes its place")
    known, n_classes = n_labels(data.train[1]), data.n_classes
    for n in study.labels:
        allowed = f"an integer from {max(n_classes, study.folds)} to {known}, or null for all {known}"
        fits = n is None or max(n_classes, study.folds) <= n <= known
        require(fits, "few_labels.labels", n, allowed)


def _settings(study: FewLabels, overrides: Sequence[str], own: Sequence[str] = ()) -> dict[str, Any]:
    """Of a run that pretrains alone."""
    composed = composed_for((*study.overrides, *overrides), (*own, "preset=default", "finetune.iterations=0"))
    settings: Any = OmegaConf.to_container(composed, resolve=False)
    return dict(settings)


def _pretrainings(study: FewLabels, overrides: Sequence[str], folder: Path) -> Iterator[PretrainingTrial]:
    for name, own in study.needed.items():
        for seed in range(min(study.pretrainings, study.draws)):
            yield PretrainingTrial(
                method=name,
                data_set=PRETRAINING,
                seed=seed,
                settings=_settings(study, overrides, own.overrides),
                build=plan_of,
                folder=str(folder),
                way=None if own.way is None else _made(own.way),
            )


def _missing(
    study: FewLabels, overrides: Sequence[str], folder: Path, records: Sequence[Record]
) -> Iterator[LabelsTrial]:
    """What the records lack and can be done now: few labels first, so that they are compared first."""
    by_key = {record.key: record for record in records}
    settings = _settings(study, overrides)
    for n in study.labels:
        for draw in range(study.n_draws(n)):
            for name, method in study.taken.items():
                trial = _trial(study, settings, folder, name, n, draw)
                if trial.key in by_key:
                    continue
                if method.after is None:
                    yield trial
                    continue
                before = by_key.get(_trial(study, settings, folder, method.after, n, draw).key)
                if before is not None:
                    yield _trial(study, settings, folder, name, n, draw, base=chosen_of(before))


def _trial(
    study: FewLabels,
    settings: dict[str, Any],
    folder: Path,
    name: str,
    n: int | None,
    draw: int,
    *,
    base: dict[str, float] | None = None,
) -> LabelsTrial:
    return LabelsTrial(
        method=name,
        seed=draw,
        labels=n,
        settings=settings,
        build=plan_of,
        learner=_learner(study, name),
        study=study,
        folder=str(folder),
        base=base,
    )


def _learner(study: FewLabels, name: str) -> Any:
    return _made(study.methods[name].learner)


def _made(settings: dict[str, Any]) -> Any:
    return instantiate(OmegaConf.create(settings), _convert_="all")
