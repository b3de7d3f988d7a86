"""Figures of the paper from the command line: the same numbers as single runs, resumed, reported."""

import csv
import json
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
import pytest
import torch
from running import HANGS_AFTER, QUIET, Outcome

from memcomp_lightning.cli import report
from memcomp_lightning.cli.commands import report as pages
from memcomp_lightning.configuration import composition
from memcomp_lightning.studies import Records
from memcomp_lightning.studies.results import at_best_validation

Run = Callable[..., Outcome]

SMALL = [
    "data=digits",
    "data.partitions=3",
    "figure.passes=[1,2]",
    "figure.seeds=[0]",
    "figure.workers=1",
    "solver.max_steps=20",
    "solver.n_restarts=3",
]
SINGLE = ["preset=paper", *QUIET, *[setting for setting in SMALL if not setting.startswith("figure")]]
NO_CONTROLS = "figure/curves=none"


def records(folder: str = "run") -> Records:
    return Records(Path(folder))


def only(found: Records, curve: str, iterations: int) -> Any:
    (record,) = [r for r in found.of(curve) if r.iterations == iterations]
    return record


@pytest.fixture
def no_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Records alone: drawing pictures takes longer than training small networks."""

    def write_page(_: list[Path], output: Path) -> None:
        output.touch()

    monkeypatch.setattr(pages, "write", write_page)


SAMPLERS = ["cd", "pcd", "dmm_qubo", "mode_assisted_pcd"]


@pytest.mark.usefixtures("no_pages")
def test_a_replica_is_the_single_run(memcomp_train: Run) -> None:
    """One sampler of each kind; two lengths and two seeds in one tensor program, the last bits may differ."""
    # Common settings of the solver are those of the DMM.
    curves = [
        f"+figure.curves.{name}={{label: {name}, overrides: ['sampler={name}', 'solver=dmm']}}"
        for name in SAMPLERS
    ]
    outcome = memcomp_train(
        "experiment=figure4",
        *SMALL,
        NO_CONTROLS,
        "figure.iterations=[1,3]",
        "figure.seeds=[0,5]",
        "figure.networks=12",
        *curves,
        "hydra.run.dir=run",
    )
    assert outcome.status == 0, outcome.err
    found = records()
    for name in SAMPLERS:
        single = memcomp_train(
            *SINGLE,
            f"sampler={name}",
            "solver=dmm",
            "pretrain.iterations=3",
            "finetune.iterations=2",
            "seed=5",
            f"hydra.run.dir=single_{name}",
        )
        assert single.status == 0, single.err
        result = json.loads(Path(f"single_{name}/result.json").read_text())
        (record,) = [r for r in found.of(name) if (r.iterations, r.seed) == (3, 5)]
        assert record.measures["test_loss"][1] == pytest.approx(result["test_loss"], rel=1e-5)
        assert record.measures["test_accuracy"][1] == pytest.approx(result["test_accuracy"], abs=1e-9)
        (other,) = [r for r in found.of(name) if (r.iterations, r.seed) == (1, 5)]
        assert record.measures["test_loss"][1] != pytest.approx(other.measures["test_loss"][1], rel=1e-5)


@pytest.mark.usefixtures("no_pages")
@pytest.mark.parametrize("place", ["--config-dir=confs", "hydra.searchpath=['file://confs']"])
def test_a_sampler_of_ones_own_is_a_curve(memcomp_train: Run, tmp_path: Path, place: str) -> None:
    """Beside one that has no solver, whose settings are common; it goes on where the place is told again."""
    (tmp_path / "confs/sampler").mkdir(parents=True)
    (tmp_path / "confs/sampler/mine.yaml").write_text("_target_: memcomp_lightning.samplers.CD\nk: 3\n")
    curve = "+figure.curves.mine={label: mine, overrides: ['sampler=mine', 'solver=alternating_descent']}"
    figure = ["experiment=figure4", *SMALL, NO_CONTROLS, "figure.iterations=[2]", curve, "hydra.run.dir=run"]
    outcome = memcomp_train(place, *figure)
    assert outcome.status == 0, outcome.err
    losses = only(records(), "mine", 2).measures["test_loss"]
    assert losses != only(records(), "cd1", 2).measures["test_loss"]
    Path("run/records.jsonl").unlink()
    assert "where settings would be looked for" in memcomp_train("resume=run").err
    outcome = memcomp_train("resume=run", place)
    assert outcome.status == 0, outcome.err
    assert only(records(), "mine", 2).measures["test_loss"] == losses


@pytest.mark.usefixtures("no_pages")
@pytest.mark.parametrize("sampler", ["cd", "pcd", "dmm_qubo"])
def test_a_replica_trained_jointly_is_the_single_run(memcomp_train: Run, sampler: str) -> None:
    joint = ["pretrain=joint", f"sampler={sampler}", "positive.max_iterations=5"]
    curve = f"+figure.curves.joint={{label: joint, overrides: {[*joint]}}}"
    figure = ["experiment=figure4", *SMALL, NO_CONTROLS, "figure.iterations=[3]", "figure.seeds=[5]", curve]
    outcome = memcomp_train(*figure, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    lengths = ["pretrain.iterations=3", "finetune.iterations=2", "seed=5"]
    single = memcomp_train(*SINGLE, *joint, *lengths, "hydra.run.dir=single")
    assert single.status == 0, single.err
    result = json.loads(Path("single/result.json").read_text())
    record = only(records(), "joint", 3)
    assert record.measures["test_loss"][1] == pytest.approx(result["test_loss"], rel=1e-5)


def test_a_sweep_of_single_runs_gives_the_same_table(memcomp_train: Run) -> None:
    """As a user would ask Hydra for Fig. 4: samplers, pretraining lengths and seeds."""
    single = ["data=digits", "finetune.iterations=2", "solver.max_steps=20", "solver.n_restarts=3"]
    sweep = ["-m", "sampler=cd,dmm_qubo", "pretrain.iterations=range(1,3)", "seed=range(2)"]
    outcome = memcomp_train(*sweep, "preset=paper", *single, *QUIET, "hydra.sweep.dir=sweep")
    assert outcome.status == 0, outcome.err
    figure = [
        "experiment=figure4",
        NO_CONTROLS,
        "data.partitions=1",
        "figure.passes=[2]",
        "figure.iterations=[1,2]",
    ]
    figure += ["figure.seeds=[0,1]", "figure.workers=1", "data=digits", *single[2:], "hydra.run.dir=run"]
    outcome = memcomp_train(*figure)
    assert outcome.status == 0, outcome.err
    curves = {"cd": "cd1", "dmm_qubo": "mem_qubo"}
    swept, replicas = (
        list(csv.DictReader(Path(p).read_text().splitlines())) for p in ("sweep/table.csv", "run/figure4.csv")
    )
    points = {(row["curve"], row["iterations"]): row for row in replicas}
    assert len(swept) == len(points) == 4
    for row in swept:
        point = points[curves[row["sampler"]], row["pretrain.iterations"]]
        assert float(row["test_accuracy_mean"]) == pytest.approx(float(point["mean"]), abs=1e-9)
        assert float(row["test_accuracy_error"]) == pytest.approx(float(point["standard_error"]), abs=1e-9)


CONTROLS = {
    **{"gaussian": 0, "bn_relu_regularised": 0},
    **{"bn_relu_pretrained": 2, "cd_best_rate": 2, "shuffled": 2, "descent": 2},
}
"""One of each kind, with the iterations of pretraining; ``test_trials`` has all of them, bit for bit."""


@pytest.fixture
def controls(memcomp_train: Run, no_pages: None, tmp_path_factory: pytest.TempPathFactory) -> Records:
    """Of a figure that has them all; trained once a worker."""
    folder = tmp_path_factory.getbasetemp() / "controls"
    if not folder.exists():
        curve = "+figure.curves.{0}={{label: {0}, overrides: ['control={0}'], iterations: [{1}]}}"
        curves = [curve.format(*control) for control in CONTROLS.items()]
        claims = "figure.claims=[{better:shuffled,than:gaussian}]"
        drop = ["~figure.curves.cd1", "~figure.curves.mem_qubo", claims]
        outcome = memcomp_train(
            "experiment=figure4", *SMALL, NO_CONTROLS, *curves, *drop, f"hydra.run.dir={folder}"
        )
        assert outcome.status == 0, outcome.err
    return Records(folder)


def applies(setting: str, control: str) -> bool:
    return not setting.startswith("solver.max_steps") or control not in ("descent", "annealing")


@pytest.mark.xdist_group("controls")
@pytest.mark.parametrize("control", CONTROLS)
def test_a_control_in_a_figure_is_the_control_of_a_single_run(
    memcomp_train: Run, controls: Records, control: str
) -> None:
    single = memcomp_train(
        *[setting for setting in SINGLE if applies(setting, control)],
        f"control={control}",
        f"pretrain.iterations={CONTROLS[control]}",
        "finetune.iterations=2",
        "hydra.run.dir=single",
    )
    assert single.status == 0, single.err
    result = json.loads(Path("single/result.json").read_text())
    record = only(controls, control, CONTROLS[control])
    if control == "bn_relu_regularised":  # the single run keeps the pass that was best on held-out images
        assert at_best_validation(record)[1] == pytest.approx(result["test_accuracy"], abs=1e-9)
    else:
        assert record.measures["test_loss"][1] == pytest.approx(result["test_loss"], rel=1e-5)
    assert record.value == result.get("choice", {"value": None})["value"]


FIGURE = [
    "experiment=figure4",
    *SMALL,
    "figure.iterations=[1,3]",
    "figure.controls_at=[2]",
    "~figure.curves.exact",
    "~figure.curves.annealing",
    "~figure.curves.descent",
    "hydra.run.dir=run",
]


def test_a_figure_is_trained_reported_and_resumed(memcomp_train: Run) -> None:
    outcome = memcomp_train(*FIGURE)
    assert outcome.status == 0, outcome.err
    assert "Mem-QUBO is above CD-1 at N = 3 (after 2 passes)" in outcome.out
    for name in (
        "figure4.png",
        "figure4.svg",
        "figure4_controls.png",
        "figure4.csv",
        "verdicts.md",
        "report.html",
    ):
        assert Path("run", name).stat().st_size > 0
    assert any(Path("run").glob("events.out.*"))
    page = Path("run/report.html").read_text()
    assert 'src="data:image/png;base64,' in page
    assert "http" not in page.replace("https://", "http", 0).split("<body>")[1].split("base64")[0]
    lines = Path("run/records.jsonl").read_text().splitlines()
    # What was chosen on held-out images is trained anew on all of them.
    assert {record.value for record in records().all if record.method == "pcd_best_rate" and record.choosing} == {
        0.05, 0.1, 0.2, 0.5, 1.0, 2.0,
    }  # fmt: skip
    assert len(records().of("pcd_best_rate")) == 1

    # An interrupted run: some records are missing, and the last line was not finished.
    Path("run/records.jsonl").write_text("\n".join(lines[:-3]) + "\n" + lines[-1][:40])
    outcome = memcomp_train("resume=run")
    assert outcome.status == 0, outcome.err
    again = Path("run/records.jsonl").read_text().splitlines()
    assert again[: len(lines) - 3] == lines[:-3]

    def measured(text: list[str]) -> list[Any]:
        parsed = [json.loads(line) for line in text]
        return sorted((r["method"], str(r["value"]), r["iterations"], r["measures"]["test_loss"]) for r in parsed)

    assert measured(again) == measured(lines)


def test_results_of_other_code_or_settings_are_not_mixed(memcomp_train: Run) -> None:
    small = ["experiment=figure4", *SMALL, NO_CONTROLS, "figure.iterations=[1,2]", "hydra.run.dir=run"]
    assert memcomp_train(*small).status == 0
    other = memcomp_train(*small, "pretrain.optimizer.lr=0.3")
    assert other.status != 0
    assert "was made with pretrain.optimizer.lr=0.1, not 0.3" in other.err
    origin = json.loads(Path("run/origin.json").read_text())
    Path("run/origin.json").write_text(json.dumps({**origin, "source": "0"}))
    other = memcomp_train(*small)
    assert other.status != 0
    assert "Results of different code are never mixed" in other.err


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+figure.curves.cd1.colour=red", "setting of figure.curves.cd1 = 'colour' is not allowed"),
        ("figure.claims=[{better:memqubo,than:cd1}]", "figure.claims = 'memqubo'"),
        ("figure.against=epochs", "figure.against = 'epochs'"),
        ("+figure.curves.x={label: x, overrides: ['sampler=cdd']}", "cdd"),
        ("+figure.curves.x={label: x, overrides: ['sampler=cd', 'sampler.kk=2']}", "kk"),
        ("figure.claims=[{better:mem_qubo,than:cd1,controls:[shufled]}]", "controls of figure.claims = 'shufled'"),
        (
            "+figure.curves.x={label: x, overrides: ['choose={setting:pretrain.iterations,values:[1]}']}",
            "choose.setting of figure.curves.x = 'pretrain.iterations'",
        ),
        (
            "+figure.curves.x={label: x, overrides: ['choose={setting:pretrain.optimizer.rate,values:[1]}']}",
            "choose.setting = 'pretrain.optimizer.rate' is no setting of this run",
        ),
    ],
)
def test_wrong_settings_of_a_figure_are_refused_before_training(
    memcomp_train: Run, override: str, message: str
) -> None:
    outcome = memcomp_train("experiment=figure4", *SMALL, NO_CONTROLS, override, "hydra.run.dir=run")
    assert outcome.status != 0
    assert message in outcome.err
    assert not Path("run/records.jsonl").exists()


def test_a_curve_is_composed_once(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not for the check and for the training: it takes a third of a second."""
    composed = []

    def counted(name: str, overrides: list[str]) -> Any:
        composed.append(tuple(overrides))
        return hydra.compose(name, overrides)

    monkeypatch.setattr(composition, "compose", counted)
    composition._composed.cache_clear()
    outcome = memcomp_train(
        "experiment=figure4", *SMALL, NO_CONTROLS, "figure.iterations=[1]", "hydra.run.dir=run"
    )
    assert outcome.status == 0, outcome.err
    assert len(set(composed)) == len(composed) == 3  # two curves, and the data


TINY = [
    "data=digits",
    "++figure.passes=[1,2]",
    "++figure.iterations=[1,2]",
    "++figure.controls_at=[1]",
    "++figure.seeds=[0]",
    "++figure.workers=1",
    "solver.max_steps=20",
    "solver.n_restarts=3",
    "preset=quick",
    "hydra.run.dir=run",
]


def test_all_figures_end_in_one_report(memcomp_train: Run) -> None:
    shown = memcomp_train("experiment=all_figures", "--cfg=job", "--package=figure")
    assert "figure2\n- figure4\n- figure5\n- figure6" in shown.out
    some = ("figure2", "figure5", "figure6")  # the fourth is trained above
    outcome = memcomp_train("experiment=all_figures", *TINY, f"figure.all=[{','.join(some)}]")
    assert outcome.status == 0, outcome.err
    page = Path("run/report.html").read_text()
    for figure in some:
        assert Path("run", figure, f"{figure}.svg").stat().st_size > 0
        assert f"<h2>{figure}: digits" in page
    assert {record.seed for record in records("run/figure5").all} == {0}
    assert [len(record.measures["test_loss"][0]) for record in records("run/figure5").of("cd1")] == [
        1,
        1,
    ]  # all images


def test_other_readings_of_the_paper_in_one_table(memcomp_train: Run) -> None:
    outcome = memcomp_train("experiment=readings", *TINY, "figure.iterations=[2]")
    assert outcome.status == 0, outcome.err
    assert "Mem-QUBO, binary inputs is above CD-1, binary inputs at N = 2 (after 2 passes)" in outcome.out
    assert not Path("run/readings.png").exists()  # one pretraining length is no curve
    assert Path("run/readings_controls.png").stat().st_size > 0
    losses = {record.method: record.measures["test_loss"][1][0] for record in records().all}
    assert len(set(losses.values())) == len(losses) == 17  # every setting does something


def test_an_annealer_in_the_place_of_the_dmm(memcomp_train: Run) -> None:
    reads = ["sampler.parameters.num_reads=5", "sampler.parameters.num_sweeps=5"]
    curve = f"figure.curves.annealer.overrides={['sampler=annealer', *reads]}"
    outcome = memcomp_train("experiment=annealer", *TINY, "figure.iterations=[2]", "figure.controls_at=[2]", curve)
    assert outcome.status == 0, outcome.err
    assert "annealer (simulated annealing, 100 reads) is above CD-1 at N = 2" in outcome.out
    losses = {record.method: record.measures["test_loss"][1][0] for record in records().all}
    assert len(set(losses.values())) == len(losses) == 7


def test_report_of_existing_folders(memcomp_train: Run, capfd: pytest.CaptureFixture[str]) -> None:
    small = ["experiment=figure4", *SMALL, NO_CONTROLS, "figure.iterations=[1,2]", "hydra.run.dir=run"]
    assert memcomp_train(*small).status == 0
    Path("run/figure4.png").unlink()
    report.main(["run", "--output", "page.html"])
    assert Path("run/figure4.png").exists()
    assert "figure4" in Path("page.html").read_text()
    with pytest.raises(SystemExit):
        report.main(["elsewhere"])
    assert "elsewhere holds no figure.json" in capfd.readouterr().err


def test_figures_train_in_processes_of_their_own(memcomp_train: Run) -> None:
    small = ["experiment=figure4", *SMALL, NO_CONTROLS, "figure.iterations=[2]", "figure.networks=3"]
    assert memcomp_train(*small, "hydra.run.dir=here").status == 0
    assert memcomp_train(*small, "figure.workers=2", "hydra.run.dir=apart").status == 0

    def losses(folder: str) -> dict[Any, Any]:
        return {record.key: record.measures["test_loss"] for record in records(folder).all}

    here, apart = losses("here"), losses("apart")
    assert here.keys() == apart.keys()
    for key, expected in here.items():
        assert torch.tensor(apart[key]).allclose(torch.tensor(expected), rtol=1e-5)


def test_a_value_that_diverges_is_not_chosen_and_a_curve_that_does_is_named(memcomp_train: Run) -> None:
    curve = (
        "+figure.curves.x={label: x, iterations: [1], "
        "overrides: ['sampler=cd', 'choose={setting:pretrain.optimizer.lr,values:%s}']}"
    )
    small = ["experiment=figure4", *SMALL, NO_CONTROLS, "~figure.curves.cd1", "~figure.curves.mem_qubo"]
    small.append("figure.claims=[{better:x,than:x}]")
    outcome = memcomp_train(*small, curve % "[1e30,0.1]", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert records().best_value("x") == 0.1
    outcome = memcomp_train(*small, curve % "[1e30]", "hydra.run.dir=other")
    assert outcome.status != 0
    assert "figure.curves.x: pretraining, layer 1: weight has an entry of" in outcome.err


def test_processes_end_with_the_one_that_started_them(start_process: Callable[..., Any], tmp_path: Path) -> None:
    """Ctrl-C is answered with how to go on; a killed run leaves nothing that computes."""
    forever = ["experiment=figure4", *SMALL, NO_CONTROLS, "figure.iterations=[1,2]", "figure.passes=[100000]"]
    forever += ["figure.workers=2", "figure.networks=3", "hydra.run.dir=run"]
    for stop in (signal.SIGINT, signal.SIGKILL):
        process = start_process(*forever)
        children = _wait_for(lambda process=process: _training_children(process.pid), 2)
        process.send_signal(stop)
        _, err = process.communicate()
        assert stop == signal.SIGKILL or "Go on with: memcomp-train resume=run" in err
        _wait_for(lambda children=children: [pid for pid in range(2) if not _alive(children[pid])], 2)


def _training_children(parent: int) -> list[int]:
    """Processes below one that have none below them and have used a second or more of processor time."""
    found = subprocess.run(["ps", "-A", "-o", "pid=,ppid=,cputimes="], capture_output=True, text=True)
    rows = [tuple(map(int, line.split())) for line in found.stdout.splitlines()]
    below, parents = {parent}, {ppid for _, ppid, _ in rows}
    for _ in range(3):
        below |= {pid for pid, ppid, _ in rows if ppid in below}
    return [pid for pid, _, seconds in rows if pid in below - parents - {parent} and seconds >= 1]


def _alive(pid: int) -> bool:
    found = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout.strip()
    return bool(found) and not found.startswith("Z")


def _wait_for(look: Callable[[], list[int]], n: int) -> list[int]:
    for _ in range(4 * HANGS_AFTER):
        if len(found := look()) >= n:
            return found
        time.sleep(0.25)
    raise AssertionError(f"there are {found}")
