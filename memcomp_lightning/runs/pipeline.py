"""The stages of one run, each picked up where it was left."""

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.fabric.utilities.spike import TrainingSpikeException
from lightning.pytorch.loggers import Logger
from lightning_utilities.core.rank_zero import rank_zero_only

from memcomp_lightning.ambient import in_one_thread
from memcomp_lightning.callbacks import LogLikelihood
from memcomp_lightning.callbacks.hyper_parameters import write_hyper_parameters
from memcomp_lightning.data.baselines import independent_log_likelihood, logistic_regression, n_fitted
from memcomp_lightning.errors import UserError
from memcomp_lightning.modules import Classifier, EnergyPretraining, NotTrainedError, load_weights, save_weights
from memcomp_lightning.modules.trainers import tries
from memcomp_lightning.modules.weights import check_checkpoint, write_tensors
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.history import passes_of, seen_before, short, total_passes
from memcomp_lightning.runs.lost import Others
from memcomp_lightning.runs.table import final_log_likelihoods
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.training import evaluate
from memcomp_lightning.training.filling import N_DRAWS

log = logging.getLogger(__name__)


def run(
    plan: Plan,
    folder: RunFolder,
    *,
    make_trainer: Callable[[Stage], pl.Trainer],
    loggers: Sequence[Logger] = (),
    settings: Mapping[str, object],
    overrides: Mapping[str, str],
    seed: int,
    choice: Mapping[str, object] | None = None,
) -> dict[str, Any]:
    """Train what is not trained yet, evaluate, and return the result.

    Every stage that is done left its weights; an interrupted one goes on from its last checkpoint. The loggers of
    the trainers get the final numbers beside ``settings``, which tell the run from others of a sweep. The result
    names what was typed, ``overrides``, and what held-out images chose before the run, ``choice``.

    Raises:
        UserError: A stage cannot be trained to its end so.
    """
    done = folder.finished_stages
    records: dict[str, Any] = {}
    keeps, schema = True, plan.stages[0].data.schema
    seen = ""
    if schema is not None and int(getattr(rank_zero_only, "rank", 0)) == 0:
        rows = plan.stages[0].data.fingerprints
        folder.keep_schema(schema.as_json())
        folder.keep_rows(rows)
        if folder.history:
            seen = seen_before(RunFolder(Path(folder.history[-1]["run"])), rows)
    if seen:
        log.warning(seen)
    if plan.finetuning is not None and plan.finetuning.data.has_gaps:
        log.info(
            "Where inputs of the classifier are missing, the pretrained model draws them, anew in each pass; "
            "held-out and test rows are judged by the mean of the class probabilities over %d draws.",
            N_DRAWS,
        )
    if int(getattr(rank_zero_only, "rank", 0)) == 0:
        folder.begin([stage.module.stage for stage in plan.stages])
    for stage in plan.stages:
        name = stage.module.stage
        if name in done and folder.weights(name).exists():
            load_weights(stage.module.network, folder.weights(name))
            records[name] = done[name]
            folder.forget_checkpoint(name)
        else:
            with _threads_for(stage):
                trainer = _fit(stage, make_trainer(stage), folder)
            keeps = trainer.is_global_zero and not tries(trainer)
            records[name] = _record(stage)
            if keeps:
                _keep_chains(stage, folder)
                save_weights(stage.module.network, folder.weights(name))
                folder.finish_stage(name, records[name])
        if stage is plan.pretraining:
            plan.fill_gaps(seed)
            plan.unfold()
            plan.change_between_stages(seed)
    result: dict[str, Any] = {"overrides": dict(overrides), "seed": seed, "stages": records}
    if folder.history:
        result["history"] = short(folder.history)
        result["total_passes"] = total_passes(folder.history, passes_of(records))
        if seen:
            result["seen_before"] = seen
    if choice is not None:
        result["choice"] = choice
    if plan.finetuning is not None:
        if plan.finetuning.data.n_labels is not None:
            result["labels"] = plan.finetuning.data.n_labels
        module, data = plan.finetuning.module, plan.finetuning.data
        assert isinstance(module, Classifier)
        score = evaluate(module.network, data.test_dataloader(), module.loss, filling=module.filling)
        result["test_accuracy"] = score.accuracy.flatten().tolist()
        result["test_loss"] = score.mean_loss.flatten().tolist()
        if data.validation is not None:
            held_out = evaluate(module.network, data.val_dataloader(), module.loss, filling=module.filling)
            result["validation_accuracy"] = held_out.accuracy.flatten().tolist()
    if keeps:
        result["context"] = _context(plan, result)
        _log_final(loggers, settings, result)
        folder.finish(result)
    return result


WORTH_THREADS = 2**22
"""Products of a unit and a weight in an update from which a second thread helps: about a millisecond."""


def _threads_for(stage: Stage) -> AbstractContextManager[None]:
    """Compute small updates in one thread, as fast as in several.

    More threads would wait for work by spinning, which makes two runs side by side ten times slower. If
    ``OMP_NUM_THREADS`` is set, nothing is changed.
    """
    n_products = stage.data.n_at_once * max(parameter.numel() for parameter in stage.module.parameters())
    alone = "OMP_NUM_THREADS" not in os.environ and n_products < WORTH_THREADS
    return in_one_thread() if alone else nullcontext()


def _fit(stage: Stage, trainer: pl.Trainer, folder: RunFolder) -> pl.Trainer:
    path = folder.checkpoint(stage.module.stage)
    resume_from = None
    if path.exists():
        check_checkpoint(stage.module, path)
        resume_from = path
        log.info("Going on from %s", path)
    others = Others()
    trainer.callbacks.append(others)  # type: ignore[attr-defined]
    try:
        trainer.fit(stage.module, datamodule=stage.data, ckpt_path=resume_from, weights_only=True)
    except (NotTrainedError, TrainingSpikeException) as error:
        raise UserError(f"{stage.module.progress}: {error}") from error
    except MisconfigurationException as error:
        raise UserError(f"{stage.module.stage}: {error}") from error
    except RuntimeError as error:
        if (lost := others.lost(error)) is not None:
            reason = str(error).partition("\n")[0].partition(" This is typically")[0]
            raise UserError(
                f"{stage.module.progress}: {lost}. Start the same command again in every process, with "
                f"hydra.run.dir={folder.path}: it goes on from the last checkpoint. ({reason})"
            ) from error
        if not str(error).startswith("Early stopping conditioned on metric"):
            raise
        raise UserError(f"callbacks.{stage.module.stage}: {error}") from error
    if not tries(trainer):
        _check_trained(stage)
    return trainer


def _check_trained(stage: Stage) -> None:
    """Raise unless each model of the stage has been trained, whatever stopped the stage."""
    passes, module = stage.module.passes, stage.module
    if len(passes) < module.n_models or min(passes) == 0:
        raise UserError(
            f"{module.stage} ended after {' and '.join(map(str, passes))} passes, before all of its "
            f"{module.n_models} models were trained: its weights are not recorded. "
            "Leave out the callback that ended it."
        )


def _keep_chains(stage: Stage, folder: RunFolder) -> None:
    """Write what a run that goes on from this one needs beside the weights."""
    left = stage.module.left() if isinstance(stage.module, EnergyPretraining) else None
    if left is not None:
        write_tensors(left, folder.chains)


def _record(stage: Stage) -> dict[str, Any]:
    record = stage.module.record()
    for callback in stage.callbacks:
        if isinstance(callback, LogLikelihood) and callback.history:
            record["log_likelihood"] = callback.history
    return record


def _context(plan: Plan, result: dict[str, Any]) -> dict[str, Any]:
    """What simple models reach on the same data; of several parts of the training set, on the first."""
    data = plan.stages[0].data
    (train, _, observed, _), (heldout, known) = data.some_train(), data.some_heldout()
    masks = {"train_observed": observed, "observed": known}
    if data.replicas:
        train = train[0]
        heldout = heldout if heldout.ndim == 2 else heldout[0]
        masks = {name: mask[0] if mask is not None and mask.ndim == 3 else mask for name, mask in masks.items()}
    context: dict[str, Any] = {}
    if plan.finetuning is not None and not plan.finetuning.data.has_gaps:
        context["logistic_regression"] = _of_regression(plan)
    if any("log_likelihood" in record for record in result["stages"].values()):
        context["independent_units"] = {"heldout": independent_log_likelihood(train, heldout, data.units, **masks)}
    return context


def _of_regression(plan: Plan) -> dict[str, Any]:
    """What logistic regression reaches on the rows of fine-tuning; of several parts, on the first."""
    assert plan.finetuning is not None
    data = plan.finetuning.data
    train, label = data.train
    if data.replicas:
        train, label = train[0], label[0]
    return {"test_accuracy": logistic_regression((train, label), data.test), "n_images": n_fitted(train)}


def _log_final(loggers: Sequence[Logger], settings: Mapping[str, object], result: dict[str, Any]) -> None:
    """The final numbers, beside the settings in TensorBoard's HParams tab."""
    metrics: dict[str, float] = {}
    if "test_accuracy" in result:
        metrics["final/test_accuracy"] = sum(result["test_accuracy"]) / len(result["test_accuracy"])
    for layer, gaps in enumerate(result["stages"].get("pretrain", {}).get("energy_gap", []), start=1):
        metrics[f"final/energy_gap_layer{layer}"] = sum(gaps) / len(gaps)
    for layer, value in enumerate(final_log_likelihoods(result), start=1):
        if value:  # none where nothing measures it
            metrics[f"final/log_likelihood_layer{layer}"] = sum(value) / len(value)
    metrics["final/wall_time_s"] = sum(record["wall_time_s"] for record in result["stages"].values())
    write_hyper_parameters(list(loggers), dict(settings), metrics)
    for logger in loggers:
        logger.finalize("success")
