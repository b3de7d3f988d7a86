"""What a user's own parts, files and lists may lack is named, in one line."""

import re
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest
from running import FAST, Outcome

import memcomp_lightning

Run = Callable[..., Outcome]
CONF = Path(memcomp_lightning.__file__).parent / "conf"
VECTOR_FIELDS = sorted(path.stem for path in (CONF / "solver/field").glob("*.yaml"))
FIGURE = ["experiment=figure4", "data=digits", "figure/curves=none", "hydra.run.dir=run"]


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (
            "_target_: mywarm.Warm",
            "sampler: no module mywarm: install it, or put the folder that holds its file on",
        ),
        ("_target_: fractions.Warm", "sampler: fractions has no Warm."),
        (
            "_target_: builtins.object",
            "sampler = 'object' is not allowed: expected a sampler of the negative phase",
        ),
        ("a: [b", "a configuration file is no YAML: while parsing"),
    ],
)
def test_a_sampler_that_cannot_be_used(memcomp_train: Run, tmp_path: Path, written: str, message: str) -> None:
    (tmp_path / "confs/sampler").mkdir(parents=True)
    (tmp_path / "confs/sampler/warm.yaml").write_text(written)
    outcome = memcomp_train("--config-dir=confs", "sampler=warm", *FAST)
    assert outcome.status == 2
    assert message in outcome.err


def test_a_folder_of_configurations_is_there_and_has_names_of_its_own(memcomp_train: Run, tmp_path: Path) -> None:
    outcome = memcomp_train("--config-dir", "confs", "sampler=cd")
    assert outcome.err == f"memcomp-train: --config-dir {tmp_path}/confs: there is no such folder.\n"
    (tmp_path / "confs/sampler").mkdir(parents=True)
    (tmp_path / "confs/sampler/cd.yaml").write_text("_target_: mine.CD")
    outcome = memcomp_train("--config-dir", "confs", "sampler=cd")
    assert "confs/sampler/cd.yaml would not be used: memcomp_lightning has a file of this name" in outcome.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pretrain.optimizer.lr=abc"], "pretrain.optimizer.lr = 'abc' is not allowed: expected a number."),
        (
            ["data.source.pixels=threshold", "data.source.threshold=abc"],
            "data.source.threshold = 'abc' is not allowed: expected a number.",
        ),
        (
            ["sampler=dmm_qubo", "solver.field=bond"],
            f"expected settings by name. Choose with solver/field=NAME: {', '.join(VECTOR_FIELDS)}. Known here: ",
        ),
        (
            ["sampler=mode_assisted_cd", "sampler.inner=cd"],
            "sampler.inner = 'cd' is not allowed: expected settings by name",
        ),
        (["trainer.precision=16-mixed"], "trainer.precision = '16-mixed' is not allowed: expected 32-true"),
        (
            ["preset=quick"],
            "preset=quick makes a figure smaller: name one, as in experiment=figure4 preset=quick.",
        ),
        ([*FIGURE, "seed=3"], "seed = '3' is not allowed: expected nothing in a figure. It has figure.seeds."),
        (
            [*FIGURE, "sampler=pcd"],
            "each curve has its own. +figure.curves.mine={label: mine, overrides: ['sampler=pcd']}",
        ),
        ([*FIGURE, "figure.passes=[]"], "figure.passes = [] is not allowed: expected a list of numbers"),
        (
            [*FIGURE, "figure.iterations=3"],
            "figure.iterations = 3 is not allowed: expected a list. Write figure.iterations=[3]",
        ),
        ([*FIGURE, "+figure.curves.x={overrides: []}"], "figure.curves.x.label = None is not allowed"),
        (["experiment=sampler_worth", "worth.only=[]"], "worth.only = [] is not allowed"),
    ],
)
def test_settings_that_cannot_be_used(memcomp_train: Run, arguments: list[str], message: str) -> None:
    outcome = memcomp_train(*arguments)
    assert outcome.status == 2
    assert message in outcome.err


def test_images_of_ones_own_from_the_page(
    memcomp_train: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[2] / "docs/extending.md").read_text()
    (code,) = [
        block for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL) if "ImageData(" in block
    ]
    (config,) = re.findall(r"two_greys.yaml`:\n\n(.*?)\n\n##", page, flags=re.DOTALL)
    (tmp_path / "your_package.py").write_text(code)
    (tmp_path / "confs/data").mkdir(parents=True)
    (tmp_path / "confs/data/two_greys.yaml").write_text(dedent(config))
    monkeypatch.syspath_prepend(tmp_path)
    outcome = memcomp_train("--config-dir=confs", "data=two_greys", "sampler=cd", *FAST, "callbacks=minimal")
    assert outcome.status == 0, outcome.err
    assert "test accuracy" in outcome.out


def test_a_kind_of_units_of_ones_own_from_the_page(
    memcomp_train: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[2] / "docs/extending.md").read_text()
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL) if "(Units)" in block]
    (config,) = re.findall(r"ternary.yaml` with\n\n(.*?)\n\n", page, flags=re.DOTALL)
    (tmp_path / "ternary_units.py").write_text(code.partition("check_units(")[0])
    (tmp_path / "confs/units").mkdir(parents=True)
    (tmp_path / "confs/units/ternary.yaml").write_text(dedent(config).replace("your_package", "ternary_units"))
    monkeypatch.syspath_prepend(tmp_path)
    run = ["--config-dir=confs", "units=ternary", "data=shifting_bars", "model.hidden_sizes=[4]", *FAST]
    outcome = memcomp_train(*run, "sampler=exact", "callbacks=diagnostics_exact", "logger=tensorboard")
    assert outcome.status == 0, outcome.err
    assert "test accuracy" in outcome.out
    assert "TrajectoryFigure is left out" in outcome.out
    refused = memcomp_train(*run, "sampler=dmm_qubo")
    assert refused.status == 2
    assert "units = 'Ternary' is not allowed: expected units with a form in bits" in refused.err


def test_a_missing_weight_file_is_trained_again_and_a_damaged_record_is_named(memcomp_train: Run) -> None:
    run = ["sampler=cd", *FAST, "callbacks=minimal", "hydra.run.dir=run"]
    assert memcomp_train(*run).status == 0
    weights = Path("run/weights/pretrain.pt")
    before = weights.read_bytes()
    weights.unlink()
    Path("run/result.json").unlink()
    assert memcomp_train("resume=run").status == 0
    assert len(weights.read_bytes()) == len(before)
    Path("run/overrides.json").write_text("{")
    outcome = memcomp_train("resume=run")
    assert outcome.status == 2
    assert "run/overrides.json is damaged" in outcome.err


def test_a_multirun_of_figures_ends_with_its_reports(memcomp_train: Run) -> None:
    small = [
        "data.partitions=2",
        "figure.passes=[1]",
        "figure.iterations=[1]",
        "figure.workers=1",
        "solver.n_restarts=3",
    ]
    figures = [*FIGURE[:-1], *small, "solver.max_steps=20,30", "hydra.sweep.dir=sweep"]
    outcome = memcomp_train("-m", *figures)
    assert outcome.status == 0, outcome.err
    assert outcome.out.count("/report.html") >= 2
    assert "failed" not in outcome.out


def test_options_of_a_group_by_pattern(memcomp_train: Run) -> None:
    outcome = memcomp_train("-m", "sampler=glob(c*)", *FAST, "callbacks=minimal", "hydra.sweep.dir=sweep")
    assert outcome.status == 0, outcome.err
    assert Path("sweep/table.csv").exists()
