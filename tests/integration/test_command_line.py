"""What a user types works, and what cannot work is refused before training."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hydra import compose
from running import FAST, MOCK_QPU, Outcome

import memcomp_lightning
from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.configuration.plans import build

Run = Callable[..., Outcome]
CONF = Path(memcomp_lightning.__file__).parent / "conf"


WITH_BEST = [setting for setting in FAST if not setting.startswith("solver.max_steps")]
"""Few updates with modes by solver=best."""


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize("sampler", [name for name in options("sampler") if name != "exact"])
def test_every_sampler_trains(memcomp_train: Run, sampler: str) -> None:
    qpu = [MOCK_QPU] if sampler == "dwave_qpu" else []
    settings = [*(FAST if "mode" not in sampler else WITH_BEST), "logger=tensorboard", "solver.n_restarts=3"]
    settings.append("hydra.run.dir=run")
    outcome = memcomp_train(f"sampler={sampler}", *qpu, *settings)
    assert outcome.status == 0, outcome.err
    assert "pretrain layer 2" in outcome.out
    assert "tensorboard --logdir run" in outcome.out
    result = json.loads(Path("run/result.json").read_text())
    assert len(result["stages"]["pretrain"]["energy_gap"]) == 2
    assert 0 <= result["test_accuracy"][0] <= 1


def test_exact_sampler_trains_a_small_model(memcomp_train: Run) -> None:
    outcome = memcomp_train(
        "sampler=exact", "data=shifting_bars", "model.hidden_sizes=[7]", "finetune.batch_size=9", *FAST
    )
    assert outcome.status == 0, outcome.err


def test_mode_assistance_spans_the_training_and_wants_whole_updates(memcomp_train: Run) -> None:
    small = [*WITH_BEST, "sampler=mode_assisted_cd", "pretrain.iterations=3"]
    for batch_size, n_updates in (("null", 3), ("500", 9)):
        overrides = [*small, f"pretrain.batch_size={batch_size}"]
        with composing():
            plan = build(compose("config", overrides))
        assert plan.pretraining is not None
        assert plan.pretraining.module.sampler.schedule.n_updates == n_updates  # type: ignore[attr-defined]
    outcome = memcomp_train(*small, "data.chunk_size=1000")
    assert outcome.status != 0
    assert "data.chunk_size = 1000 is not allowed: expected at least the 1437 images of an update" in outcome.err


MANY_RUNS = (
    *("figure2", "figure4", "figure5", "figure6", "all_figures", "readings", "joint", "annealer"),
    *("sampler_worth", "joint_likelihood", "density", "few_labels"),
)
"""Experiments with tests of their own."""

OTHERS = [name for name in options("experiment") if name not in (*MANY_RUNS, "full_size")]
"""Those that train at once, without MNIST."""


@pytest.mark.parametrize("experiment", OTHERS)
def test_every_experiment_runs_fast(memcomp_train: Run, experiment: str) -> None:
    outcome = memcomp_train(f"experiment={experiment}", "trainer.fast_dev_run=true", "solver.max_steps=20")
    assert outcome.status == 0, outcome.err


BESIDE = [(callbacks, "both") for callbacks in options("callbacks")]
BESIDE += [("default", "none"), ("diagnostics", "csv"), ("diagnostics_exact", "tensorboard")]
"""Each set of callbacks and each logger, those of diagnostics without a board, too."""


@pytest.mark.parametrize(("callbacks", "logger"), BESIDE)
def test_every_logger_and_set_of_callbacks(memcomp_train: Run, callbacks: str, logger: str) -> None:
    # Small enough to enumerate, which diagnostics_exact does.
    settings = ["sampler=cd", "model.hidden_sizes=[7]", *FAST, "hydra.run.dir=run"]
    outcome = memcomp_train(*settings, f"logger={logger}", f"callbacks={callbacks}")
    assert outcome.status == 0, outcome.err
    assert Path("run/csv/version_0/metrics.csv").exists() == (logger in ("csv", "both"))
    assert any(Path("run").glob("events.out.*")) == (logger in ("tensorboard", "both"))


def test_baseline_and_partitions_report_mean_and_error(memcomp_train: Run) -> None:
    outcome = memcomp_train("model=baseline_bn_relu", "data.partitions=3", *FAST, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert "pretrain" not in outcome.out
    assert "±" in outcome.out
    assert len(json.loads(Path("run/result.json").read_text())["test_accuracy"]) == 3


def test_help_names_groups_and_examples(memcomp_train: Run) -> None:
    outcome = memcomp_train("--help")
    assert outcome.status == 0
    assert "sampler: annealer, block_annealing, cd, dmm_qubo" in outcome.out
    assert "resume=RUN_FOLDER" in outcome.out


REFUSED = {
    "pretrain.iteration=3": ["pretrain.iteration=3", "does not exist", "Did you mean pretrain.iterations?"],
    "sead=3": ["sead=3", "Did you mean seed?"],
    "foo": ["foo is no setting", "NAME=VALUE"],
    "sampler=foo": ["sampler = 'foo'", "cd, dmm_qubo"],
    "pretrain.products=bf17": ["pretrain.products = 'bf17'", "'float32', 'bf16'"],
    "pretrain.iterations=-1": ["pretrain.iterations = -1", "an integer >= 0"],
    "pretrain.iterations=abc": ["pretrain.iterations = 'abc'", "an integer >= 0"],
    "finetune.iterations=1.5": ["finetune.iterations = 1.5", "an integer >= 0"],
    "solver.n_restarts=0": ["n_restarts = 0", "an integer >= 1"],
    "figure=figure4": ["an experiment sets it", "experiment=NAME"],
    "--hlep": ["--hlep is no option. Did you mean --help?"],
    "solver.patience=99": ["patience = 99", "1 to n_restarts = 28"],
    "solver.field.gamma=2": ["gamma = 2", "(0, 1/2)"],
    "pretrain.optimizer.lr=-1": ["pretrain.optimizer", "-1"],
    "data.partitions=0": ["data.partitions = 0", "an integer >= 1"],
    "seed=1.5": ["seed = 1.5", "an integer"],
    "model.hidden_sizes=[0]": ["n_hidden = 0", "an integer >= 1"],
    "model.weights=none.pt": ["none.pt does not exist"],
    "sampler=dwave_qpu": ["Set DWAVE_API_TOKEN", "sampler=annealer needs neither"],
    "sampler=exact": ["32 is not allowed", "max_units = 16"],
    "trainer.devices=0": ["devices=0"],
    "checkpoint_every=0": ["checkpoint_every = 0", "an integer >= 1"],
    "hydra.run.dir=/proc/none": ["hydra.run.dir = /proc/none", "no file can be written"],
    "+keep=1": ["setting = 'keep'", "'pretrain'"],
    "+pretrain.lr=1": ["setting pretrain = 'lr'", "'optimizer'"],
    "data.validation_fraction=abc": ["validation_fraction = 'abc'", "a number in [0, 1)"],
    "pretrain.optimizer.lr=nan": ["pretrain.optimizer.lr = nan", "a finite number"],
    "finetune.optimizer._target_=torch.optim.Adam": ["'momentum'", "'~finetune.optimizer.momentum'"],
    "+trainer.max_epochs=3": ["trainer.max_epochs = 3", "each stage sets it"],
    "+trainer.gradient_clip_val=1": ["trainer.gradient_clip_val = 1", "step their optimisers themselves"],
    "resume=nowhere": ["resume=nowhere", "overrides.json"],
}


@pytest.mark.parametrize("override", REFUSED)
def test_refused_before_training(memcomp_train: Run, override: str) -> None:
    outcome = memcomp_train(override)
    assert outcome.status == 2
    assert outcome.err.startswith("memcomp-train: ")
    assert "Traceback" not in outcome.err
    for part in REFUSED[override]:
        assert part in outcome.err
    assert not list(Path.cwd().rglob("*")), "a refused run leaves nothing behind"


def test_missing_mnist_says_what_where_and_how(memcomp_train: Run) -> None:
    outcome = memcomp_train("data=mnist", "data.source.data_dir=/nowhere", "data.source.download=false")
    assert outcome.status == 2
    for part in ("/nowhere/MNIST/raw/train-images-idx3-ubyte", "MEMCOMP_DATA_DIR", "data=digits"):
        assert part in outcome.err


def test_folder_of_other_settings_is_refused(memcomp_train: Run) -> None:
    assert memcomp_train("sampler=cd", *FAST, "hydra.run.dir=run").status == 0
    outcome = memcomp_train("sampler=cd", *FAST, "hydra.run.dir=run", "pretrain.iterations=3")
    assert outcome.status == 2
    assert "pretrain.iterations=2, not 3" in outcome.err
    assert "Traceback" not in outcome.err


def test_truncated_checkpoint_is_named(memcomp_train: Run) -> None:
    arguments = ("sampler=cd", *FAST, "hydra.run.dir=run")
    assert memcomp_train(*arguments).status == 0
    weights = Path("run/weights/pretrain.pt")
    Path("run/result.json").unlink()
    weights.write_bytes(weights.read_bytes()[:500])
    outcome = memcomp_train(*arguments)
    assert outcome.status == 2
    assert "run/weights/pretrain.pt" in outcome.err
    assert "Traceback" not in outcome.err
    Path("run/stages.json").unlink()
    checkpoint = Path("run/checkpoints/pretrain/last.ckpt")
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.write_bytes(b"PK\x03\x04")
    outcome = memcomp_train(*arguments)
    assert outcome.status == 2
    assert "run/checkpoints/pretrain/last.ckpt" in outcome.err


def test_a_refused_command_does_not_spoil_resume(memcomp_train: Run) -> None:
    folder = "a run,sampler=cd"
    assert memcomp_train("sampler=cd", *FAST, f"hydra.run.dir='{folder}'").status == 0
    assert memcomp_train("sampler=pcd", *FAST, f"hydra.run.dir='{folder}'").status == 2
    outcome = memcomp_train(f"resume={folder}")
    assert outcome.status == 0, outcome.err
    assert "test accuracy" in outcome.out


def test_a_stage_cut_short_is_not_recorded(memcomp_train: Run) -> None:
    outcome = memcomp_train("sampler=cd", *FAST, "+trainer.max_time=00:00:00:00", "hydra.run.dir=run")
    assert outcome.status != 0
    assert "ended without an optimiser step" in outcome.err
    assert not Path("run/result.json").exists()


@pytest.mark.parametrize("stage", ["pretrain", "finetune"])
def test_divergence_ends_with_its_cause(memcomp_train: Run, stage: str) -> None:
    outcome = memcomp_train("sampler=cd", *FAST, f"{stage}.optimizer.lr=1e30", "hydra.run.dir=run")
    assert outcome.status == 2
    assert "training diverged" in outcome.err
    assert f"{stage}.optimizer.lr" in outcome.err
    assert not Path("run/result.json").exists()


def test_double_precision_trains_and_resumes(memcomp_train: Run) -> None:
    arguments = ("sampler=cd", *FAST, "hydra.run.dir=run", "trainer.precision=64-true")
    assert memcomp_train(*arguments).status == 0
    assert torch.load("run/weights/finetune.pt", weights_only=True)["0.rbms.0.weight"].dtype == torch.float64
    Path("run/result.json").unlink()
    assert memcomp_train(*arguments).status == 0


@pytest.mark.parametrize("content", [b"", b"abc", b"PK", bytes([128])], ids=["empty", "text", "zip", "pickle"])
def test_any_damaged_weight_file_is_named(memcomp_train: Run, content: bytes) -> None:
    Path("damaged.pt").write_bytes(content)
    outcome = memcomp_train("model.weights=damaged.pt")
    assert outcome.status == 2
    assert "checkpoint damaged.pt" in outcome.err


def test_finished_run_is_not_repeated(memcomp_train: Run) -> None:
    arguments = ("sampler=cd", *FAST, "hydra.run.dir=run")
    first = memcomp_train(*arguments)
    written = Path("run/result.json").stat().st_mtime_ns
    again = memcomp_train(*arguments)
    assert again.status == 0
    assert Path("run/result.json").stat().st_mtime_ns == written
    assert first.out.splitlines()[-6:] == again.out.splitlines()[-6:]


def test_weights_of_another_shape_and_damaged_weights_are_refused(memcomp_train: Run) -> None:
    assert memcomp_train("sampler=cd", *FAST, "hydra.run.dir=run").status == 0
    weights = Path("run/weights/pretrain.pt")
    outcome = memcomp_train(f"model.weights={weights}", "model.hidden_sizes=[7,5]")
    assert outcome.status == 2
    assert "rbms.0.b has shape (32,)" in outcome.err or "shape (32, 32)" in outcome.err
    damaged = Path("damaged.pt")
    damaged.write_bytes(weights.read_bytes()[:500])
    outcome = memcomp_train(f"model.weights={damaged}")
    assert outcome.status == 2
    assert "truncated" in outcome.err or "damaged" in outcome.err


def test_code_in_weights_is_not_executed(memcomp_train: Run, tmp_path: Path) -> None:
    class Attack:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (tmp_path / "executed",))

    torch.save({"weight": Attack()}, "attack.pt")
    outcome = memcomp_train("model.weights=attack.pt")
    assert outcome.status == 2
    assert "never executed" in outcome.err
    assert not Path("executed").exists()


def test_pretrained_weights_start_another_run(memcomp_train: Run) -> None:
    assert memcomp_train("sampler=cd", *FAST, "hydra.run.dir=first").status == 0
    outcome = memcomp_train(
        *(*FAST, "model.weights=first/weights/pretrain.pt", "pretrain.iterations=0", "hydra.run.dir=second")
    )
    assert outcome.status == 0, outcome.err
    results = [json.loads(Path(name, "result.json").read_text()) for name in ("first", "second")]
    assert results[0]["test_loss"] == results[1]["test_loss"]


def test_a_missing_package_names_the_extra_to_install(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dimod", None)
    for module in ("problems.bqm", "solvers.dimod", "samplers.annealer"):
        monkeypatch.delitem(sys.modules, f"memcomp_lightning.{module}", raising=False)
    outcome = memcomp_train("sampler=annealer")
    assert outcome.status == 2
    assert "pip install 'memcomp-lightning[dimod]'" in outcome.err


@pytest.mark.parametrize(
    "argument",
    ["hydra.run.dir=s3://bucket/run", "hydra.run.dir=memory://run"],
)
def test_addresses_of_object_stores_are_no_folders(memcomp_train: Run, argument: str) -> None:
    outcome = memcomp_train("sampler=cd", argument)
    name, _, value = argument.partition("=")
    assert outcome.status == 2
    assert f"{name} = {value} is not allowed: expected a folder of a file system." in outcome.err
    assert f"{name}=runs/mine copy_to={value}" in outcome.err
    assert list(Path().iterdir()) == []
