"""``memcomp-train``: pretrain, fine-tune, evaluate."""

import logging
import os
import shlex
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import hydra
from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning_utilities.core.rank_zero import rank_zero_only
from omegaconf import DictConfig

from memcomp_lightning.cli import launched, sweep
from memcomp_lightning.cli.arguments import CommandLine, read
from memcomp_lightning.cli.commands import report
from memcomp_lightning.cli.continued import Written, to_trust, with_settings_of_run
from memcomp_lightning.cli.output import make_tolerant, refuse, say
from memcomp_lightning.cli.overrides import answering, check_command_line, going_on, search_path
from memcomp_lightning.cli.search import check_searchable
from memcomp_lightning.configuration import comparisons, densities, few_labels, figures, trajectory
from memcomp_lightning.configuration.choice import for_trial, settle, tried_values
from memcomp_lightning.configuration.composition import CONFIG_MODULE, checking, study_of
from memcomp_lightning.configuration.continued import earlier_of
from memcomp_lightning.configuration.errors import explain, in_words
from memcomp_lightning.configuration.hydra_versions import MAIN, instantiate
from memcomp_lightning.configuration.plans import build, check_without_trainer
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.configuration.trainers import check_trainers, trainer_of
from memcomp_lightning.errors import SettingError, UserError, require, require_count
from memcomp_lightning.modules import CheckpointError
from memcomp_lightning.runs import pipeline
from memcomp_lightning.runs.addresses import NotCopiedError, address_of, check_address, copying, is_address
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.history import history_with
from memcomp_lightning.runs.lock import InUseError
from memcomp_lightning.runs.table import closing_lines, run_table, short_path
from memcomp_lightning.training import DivergedError

COMMAND = "memcomp-train"

_ALONE = {"worth": comparisons, "density": densities, "few_labels": few_labels}
"""What checks and trains a study that is no figure, by its setting."""

_DAY = 86_400

log = logging.getLogger(__name__)


@hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name="config", **MAIN)
def train(config: DictConfig) -> float | None:
    """One run, or one job of a sweep.

    Returns:
        What a search goes by: accuracy on held-out training images after the last pass, mean over replicas; 0 of a
        job that diverged. None where no images are held out, or a job failed.
    """
    settings = HydraConfig.get()
    # Again: a parallel launcher starts jobs in processes of their own.
    make_tolerant()
    _silence_lightning()
    os.chdir(settings.runtime.cwd)  # paths are meant from there, with hydra.job.chdir=true, too
    folder = RunFolder(Path(settings.runtime.output_dir))
    in_sweep = settings.mode == RunMode.MULTIRUN
    score: float | None = None
    try:
        address = _address(config, folder, settings) if _is_first_process() else None
        trains, alone = _is_first_process() and folder.result is None, launched.launched() is None
        with (
            folder.held() if trains else nullcontext(),
            copying(folder.path, address, config.copy_every, fetches=alone),
        ):
            score = _train(config, folder, [*search_path(settings), *settings.overrides.task])
    except NotCopiedError as error:
        again = shlex.join([COMMAND, with_path("resume", short_path(folder.path)), *_copies(folder)])
        said = UserError(f"{error} The run is whole in {short_path(folder.path)}. Copy it with: {again}")
        if not in_sweep:
            refuse(COMMAND, said)
        log.error("%s", said)
    except Exception as error:
        if not in_sweep and isinstance(error, (UserError, SettingError, CheckpointError, DivergedError)):
            refuse(COMMAND, error)
        if not in_sweep:
            raise
        record = {"error": f"{type(error).__name__}: {explain(error)}", "traceback": traceback.format_exc()}
        if not isinstance(error, InUseError):  # what is in the folder is the other's
            with suppress(OSError):  # which may be what it failed by
                folder.fail(record)
        log.error("Failed, the sweep goes on: %s", explain(error))
        return 0.0 if isinstance(error, DivergedError) else None
    return score


def _address(config: DictConfig, folder: RunFolder, settings: HydraConf) -> str | None:
    """Where the run is copied to, a job of a sweep by the name of its folder there; None if nowhere."""
    if config.copy_to is None or settings.mode != RunMode.MULTIRUN:
        return None if config.copy_to is None else str(config.copy_to)
    job = os.path.relpath(folder.path, settings.sweep.dir).replace(os.sep, "/")
    return f"{str(config.copy_to).rstrip('/')}/{job}"


def _check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build a job, and train nothing."""
    if config.copy_to is not None:
        of_store = is_address(str(config.copy_to))
        require(of_store, "copy_to", config.copy_to, "an address, s3://bucket/run or file:///folder")
        require(0 < config.copy_every <= _DAY, "copy_every", config.copy_every, f"seconds in (0, {_DAY}]")
        check_address(config.copy_to)
    if study_of(config) is not None:
        allowed = "null: figures and comparisons train new networks"
        require(config["continue"] is None, "continue", config["continue"], allowed)
        launched.check_alone("A figure or a comparison", "Start it once: its setting workers spreads it.")
        for study, part, own in _studies(config, overrides).values():
            study.check(part, own)
        return
    launched.check_config(config)
    for name, logger in config.logger.items():
        writes_events = logger is not None and str(logger.get("_target_")).endswith("TensorBoardLogger")
        if writes_events and find_spec("tensorboard") is None:
            raise UserError(
                f"logger.{name}: TensorBoard is not installed: pip install tensorboard, or logger=csv."
            )
    values = tried_values(config)
    n_passes = config.finetune.iterations
    require_count("finetune.iterations", n_passes, minimum=0)
    if values:
        launched.check_alone("choose", "Let one process choose, and give what it chose as a setting.")
    require(n_passes > 0 or not values, "finetune.iterations", n_passes, "an integer >= 1 where choose is set")
    plans = [build(own) for own in [for_trial(config, value) for value in values] or [config]]
    if values:
        allowed = "null where the data have no labels: accuracy on held-out rows chooses"
        require(plans[0].finetuning is not None, "choose.setting", config.choose.setting, allowed)
        check_without_trainer(plans[0], for_trial(config, values[0]))
    check_trainers(plans[0], config)


def _check_trusted(written: Written, config: DictConfig, overrides: Sequence[str]) -> None:
    """Build a job that goes on with a run, if it names nothing that is not trusted."""
    written.check(config)
    _check(config, overrides)


def _studies(config: DictConfig, overrides: Sequence[str]) -> dict[str, tuple[ModuleType, DictConfig, list[str]]]:
    """What checks and trains a comparison, or each figure of a run, with its settings, by the folder of each."""
    if (alone := _ALONE.get(study_of(config) or "")) is not None:
        return {".": (alone, config, list(overrides))}
    if not {"name", "all"} & set(config.figure):
        raise UserError("preset=quick makes a figure smaller: name one, as in experiment=figure4 preset=quick.")
    parts = figures.parts(config, overrides).items()
    return {name: (figures if "curves" in part.figure else trajectory, part, own) for name, (part, own) in parts}


def _train(config: DictConfig, folder: RunFolder, overrides: list[str]) -> float | None:
    if study_of(config) is not None:
        _many(config, folder, overrides)
        return None
    if _is_first_process():
        _open(folder, config, overrides)
    result = folder.result
    if result is None:
        with _resumable(folder, config, overrides):
            config, choice = settle(config, folder)
            loggers = [instantiate(logger) for logger in config.logger.values() if logger is not None]
            pairs = [override.partition("=") for override in overrides if not override.startswith("hydra.")]
            by_name = {name: value for name, _, value in pairs}
            plan = build(config)
            earlier = earlier_of(config)
            if _is_first_process() and earlier is not None:
                folder.keep_history(history_with(earlier.folder, earlier.weights))
            if _is_first_process() and plan.described:
                say(f"{plan.described}\n")
            try:
                result = pipeline.run(
                    plan,
                    folder,
                    make_trainer=lambda stage: trainer_of(stage, config, folder, loggers),
                    loggers=loggers,
                    settings=_distinguishing_settings(config, by_name),
                    overrides=by_name,
                    seed=config.seed,
                    choice=choice,
                )
            except SystemExit as stop:  # as Lightning ends after a KeyboardInterrupt
                raise KeyboardInterrupt from stop
    else:
        log.info("%s is finished already", folder.path)
    if _is_first_process():
        say(f"\n{run_table(result)}\n{closing_lines(short_path(folder.path))}")
    held_out = result.get("validation_accuracy")
    return sum(held_out) / len(held_out) if held_out else None


def _many(config: DictConfig, folder: RunFolder, overrides: list[str]) -> None:
    """Train what a figure or a comparison needs, and write the report."""
    _open(folder, config, overrides)
    with _resumable(folder, config, overrides):
        folder.check_source()
        studies = _studies(config, overrides)
        for name, (study, part, own) in studies.items():
            (folder.path / name).mkdir(exist_ok=True)
            study.train(part, own, folder.path / name)
        report.write([folder.path / name for name in studies], folder.report)
    folder.forget_error()


def _open(folder: RunFolder, config: DictConfig, overrides: Sequence[str]) -> None:
    with going_on(lambda: shlex.join([COMMAND, *sys.argv[1:]])):
        folder.open(config, overrides)


def _copies(folder: RunFolder) -> list[str]:
    address = address_of(folder.path)
    return [] if address is None else [with_path("copy_to", address)]


@contextmanager
def _resumable(folder: RunFolder, config: DictConfig, overrides: Sequence[str]) -> Iterator[None]:
    """Name the command that goes on where a run that has begun is ended from outside."""

    def command() -> str:
        beside = [*to_trust(config, overrides, folder.path), *_copies(folder)]
        return shlex.join([COMMAND, f"resume={short_path(folder.path)}", *beside])

    try:
        with going_on(command, any_file=True):
            yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(f"Go on with: {command()}") from stop


def _is_first_process() -> bool:
    """Whether this is the process that writes; Lightning reads the rank from the environment."""
    return int(getattr(rank_zero_only, "rank", 0)) == 0


def main() -> None:
    """Check everything, train, and end with a table or a message."""
    _silence_lightning()
    try:
        if "LOCAL_RANK" not in os.environ or launched.launched() is not None:
            line, written = _read(sys.argv[1:])
            with checking(None if written is None else written.check):
                try:
                    line = check_command_line(
                        line,
                        config_name="config",
                        check=_check if written is None else partial(_check_trusted, written),
                        folders=("runs", "multirun"),
                        check_searchable=check_searchable,
                    )
                except OSError as error:
                    raise UserError(in_words(error)) from error
                sys.argv[1:] = line.arguments
                with answering(line, COMMAND):
                    train()
                    _end_of_sweep(line)
        else:
            train()
    except UserError as error:
        refuse(COMMAND, error)
    except KeyboardInterrupt as interrupt:
        if sweep.RememberSweepFolder.folder is not None:
            raise KeyboardInterrupt(f"Go on with: {shlex.join([COMMAND, *sys.argv[1:]])}") from interrupt
        raise


def _end_of_sweep(line: CommandLine) -> None:
    """Show the table of a sweep, if this was one, and end with whether a job failed."""
    if (folder := sweep.RememberSweepFolder.folder) is not None:
        table, n_failed = sweep.merge(folder, line.planned)
        say(f"\n{table}\n{closing_lines(short_path(folder))}")
        if n_failed:
            say(f"Go on with: {shlex.join([COMMAND, *sys.argv[1:]])}")
        sys.exit(1 if n_failed else 0)


def _read(arguments: list[str]) -> tuple[CommandLine, Written | None]:
    try:
        arguments, written = with_settings_of_run(arguments)
    except OSError as error:
        raise UserError(in_words(error)) from error
    line = read(arguments)
    devices = line.value("trainer.devices")
    if line.multirun and devices not in (None, "1"):
        raise UserError(
            "trainer.devices > 1 in a multirun: each job would start the whole sweep again in its other "
            "processes. Give the jobs one by one, or use one device with a parallel launcher."
        )
    return launched.check_line(line), written


def _silence_lightning() -> None:
    """Keep Lightning's remarks on hardware and tips, and a deprecation inside it, from the user's screen."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*LeafSpec.*", category=FutureWarning)
    # On every machine of a cluster, whose launchers do use it where it is meant to be used.
    warnings.filterwarnings("ignore", message="The `srun` command is available on your system but is not used")
    warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")  # a resumed run


def _distinguishing_settings(config: DictConfig, overrides: dict[str, str]) -> dict[str, object]:
    """What tells runs of a sweep apart: TensorBoard shows the first five, and more where more was overridden."""
    choices = HydraConfig.get().runtime.choices
    settings = {group: choices[group] for group in ("data", "model", "sampler")}
    settings |= {"seed": config.seed, "pretrain.iterations": config.pretrain.iterations}
    return settings | {name: value for name, value in overrides.items() if name not in settings}
