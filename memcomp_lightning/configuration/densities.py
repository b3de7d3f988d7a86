"""``experiment=density``: energy models of tables by many negative phases, and peers, by likelihood."""

import math
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
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
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.configuration.values import filled
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.files import write_json
from memcomp_lightning.studies import Record, Records, runner
from memcomp_lightning.studies.density import Density, DensityTrial, Peer, PeerTrial, peers_of
from memcomp_lightning.studies.plan import pretraining_of, require_bits
from memcomp_lightning.studies.search import Axes, Setting, best_of, missing, text_of

CHOOSES = 1000
"""The seed by which settings are chosen; those that are reported count from 0."""

_SET_BY_STUDY = {
    "data": "Use density.folder and density.tables.",
    "model": "Each of density.models has its own.",
    "model.hidden_sizes": "Use density.start.hidden and density.axes.hidden.",
    "model.n_hidden": "Use density.start.hidden and density.axes.hidden.",
    "pretrain.updates": "Use density.start.updates and density.axes.updates.",
    "pretrain.iterations": "Use density.start.updates and density.axes.updates.",
    "pretrain.optimizer.lr": "Use density.start.rate and density.axes.rate.",
    "sampler": "Each of density.models has its own.",
    "seed": "Use density.replicas.",
}
_FILES = ("train", "valid", "test")
_ENDINGS = (".csv.gz", ".csv")

Files = tuple[str, str, str]


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Find the tables, ask for the peers, and build every model at its start; raises as ``build``."""
    check_not_given(overrides, _SET_BY_STUDY, "a comparison")
    density = filled(Density, config.density, "density")
    require_choice("trainer.accelerator", config.trainer.accelerator, ("auto", "cpu"))
    peers = _peers(density)
    for name in density.only or ():
        require_choice("density.only", name, (*density.models, *peers))
    files = {table: files_of(density, table) for table in density.tables}
    first = density.tables[0]
    for name in _models(density):  # on one table alone: building takes a second
        trial = trial_of(density, overrides, first, files[first], name, density.start_of(name), choosing=True)
        own = OmegaConf.create(trial.settings)
        plan = build(own)
        check_without_trainer(plan, own)
        stage, module = pretraining_of(plan)
        require_bits(stage.data, "seeds")
        phases = len(module.phases)
        remedy = "A deep one is trained with pretrain=joint."
        require(phases == 1, f"density.models.{name}", f"{phases} trainings", "one of all units", remedy)


def train(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Search and report what is missing, table by table; each record is written when it exists."""
    density, records = filled(Density, config.density, "density"), Records(folder)
    peers = _peers(density)
    found = {name: asdict(peer) for name, peer in peers.items()}
    write_json(folder / "density.json", {**asdict(density), "found_peers": found})
    with runner(density.name, workers=density.workers) as run:
        for table in density.tables:
            while work := list(_missing(density, peers, overrides, table, records)):
                run(work, records)


def _missing(
    density: Density, peers: Mapping[str, Peer], overrides: Sequence[str], table: str, records: Records
) -> Iterator[DensityTrial | PeerTrial]:
    """What the records of a table lack: settings that a search asks for next, or the one that it chose."""
    files, done = files_of(density, table), records.keys
    for name in _models(density):
        axes, start = density.axes_of(name), density.start_of(name)
        judged = _judged(records.all, table, name)
        asked = missing(axes, start, judged)
        for setting in asked or _known(axes, start, judged):
            trial = trial_of(density, overrides, table, files, name, setting, choosing=bool(asked))
            if trial.key not in done:
                yield trial
    for name, peer in peers.items():
        if density.takes(name):
            judged = _judged(records.all, table, name)
            asked = missing(peer.axes, peer.start, judged)
            seeds = [CHOOSES] if asked else range(density.peer_replicas)
            for setting in asked or _known(peer.axes, peer.start, judged):
                for seed in seeds:
                    fit = _fit(density, table, files, name, setting, seed)
                    if fit.key not in done:
                        yield fit


def _known(axes: Axes, start: Setting, judged: Mapping[str, float]) -> list[Setting]:
    """The setting that a search chose; none where not one of those that it tried could be judged."""
    found = best_of(axes, start, judged)
    return [found] if judged[text_of(found)] > -math.inf else []


def _judged(records: Sequence[Record], table: str, method: str) -> dict[str, float]:
    own = (record for record in records if record.choosing and (record.data_set, record.method) == (table, method))
    return {record.setting: -math.inf if record.held_out is None else record.held_out for record in own}


def _models(density: Density) -> list[str]:
    return [name for name in density.models if density.takes(name)]


def _peers(density: Density) -> dict[str, Peer]:
    if density.peers is None:
        require(
            density.peers_python is None,
            "density.peers_python",
            density.peers_python,
            "null without density.peers",
        )
        return {}
    return peers_of(density.peers_python or sys.executable, density.peers)


def _fit(density: Density, table: str, files: Files, name: str, setting: Setting, seed: int) -> PeerTrial:
    assert density.peers is not None
    return PeerTrial(
        method=name,
        data_set=table,
        setting=text_of(setting),
        seed=seed,
        choosing=seed == CHOOSES,
        python=density.peers_python or sys.executable,
        program=density.peers,
        files=files,
        betas=density.betas,
        chains=density.chains,
    )


def trial_of(
    density: Density,
    overrides: Sequence[str],
    table: str,
    files: Files,
    name: str,
    setting: Setting,
    *,
    choosing: bool,
) -> DensityTrial:
    """The trial of a model of the comparison at one setting; a choosing one has another seed, and no test rows."""
    model = density.models[name]
    at = f"density.models.{name}"
    common = (*(_filled_in(one, setting, "density.overrides") for one in density.overrides), *overrides)
    own = [_filled_in(one, setting, f"{at}.overrides") for one in model.overrides]
    keys = ("data.path", "data.validation", "data.test")
    own += [with_path(key, file) for key, file in zip(keys, files, strict=True)]
    first = composed_for(common, (*own, *settings_of_comparison(1)))
    plan = build(first)
    n_train, size = pretraining_of(plan)[0].data.n_train, first.pretrain.batch_size
    passes = max(1, round(setting["updates"] / math.ceil(n_train / min(size or n_train, n_train))))
    composed = composed_for(common, (*own, *settings_of_comparison(passes)))
    settings: Any = OmegaConf.to_container(composed, resolve=False)
    return DensityTrial(
        method=name,
        data_set=table,
        setting=text_of(setting),
        choosing=choosing,
        density=density,
        settings=settings,
        build=plan_of,
        seeds=(CHOOSES,) if choosing else tuple(range(density.replicas)),
        points=_points(passes, density.points),
    )


def _filled_in(override: str, setting: Setting, at: str) -> str:
    """An override with the values of the settings that it names in braces."""

    def value(found: re.Match[str]) -> str:
        require_choice(f"{at}: {override}: setting", found[1], tuple(setting))
        return str(setting[found[1]])

    return re.sub(r"\{(\w+)\}", value, override)


def _points(passes: int, n: int) -> tuple[int, ...]:
    """Passes of which each is one and a half times the one before, the last one included.

    >>> _points(100, 4)
    (30, 44, 67, 100)
    """
    return tuple(sorted({max(1, round(passes / 1.5**k)) for k in range(n)}))


def files_of(density: Density, table: str) -> Files:
    """Of training, held-out and test rows."""
    given = density.folder
    if given is None and "MEMCOMP_DATA_DIR" not in os.environ:
        raise UserError(
            "density.folder=null: MEMCOMP_DATA_DIR is not set. Name the folder: density.folder=FOLDER."
        )
    folder = Path(os.environ["MEMCOMP_DATA_DIR"]) / "tables" if given is None else Path(given).expanduser()
    found = []
    for part in _FILES:
        candidates = [folder / f"{table}.{part}{ending}" for ending in _ENDINGS]
        file = next((path for path in candidates if path.is_file()), None)
        if file is None:
            names = " or ".join(path.name for path in candidates)
            raise UserError(
                f"density.tables: {table}: {folder} holds no {names}. Name its folder: density.folder=FOLDER."
            )
        found.append(str(file.resolve()))
    return found[0], found[1], found[2]
