"""Arguments are read as they were meant, or refused in one line that names them and says how to write them."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from running import Outcome

import memcomp_lightning
from memcomp_lightning import __version__
from memcomp_lightning.cli import arguments
from memcomp_lightning.cli.arguments import from_folder, read
from memcomp_lightning.cli.overrides import _check_options
from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.errors import UserError

Run = Callable[..., Outcome]
CONF = Path(memcomp_lightning.__file__).parent / "conf"
SHORT = ["sampler=cd", "pretrain.iterations=1", "finetune.iterations=1", "callbacks=minimal", "logger=none"]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def value(override: str) -> object:
    (parsed,) = OverridesParser.create().parse_overrides([override])
    return parsed.value()


REFUSED = {
    "seed=3\r": ["seed=3 ", r"'seed=3\r'", "line endings"],
    "seed=\x003": ["cannot be seen"],
    "model.weights=caf\udce9.pt": [r"model.weights=caf\udce9.pt", "UTF-8"],
    "\N{EN DASH}m": ["EN DASH", "write -m"],
    "\N{EM DASH}multirun": ["EM DASH", "write --multirun"],
    "seed=\N{MINUS SIGN}3": ["MINUS SIGN", "write seed=-3"],
    "seed=\N{NO-BREAK SPACE}3": ["NO-BREAK SPACE", "write seed=3"],
    "\N{LEFT DOUBLE QUOTATION MARK}seed=3\N{RIGHT DOUBLE QUOTATION MARK}": ["LEFT DOUBLE QUOTATION MARK"],
    "": ["An empty argument"],
    "=cd": ["=cd", "NAME=VALUE"],
    "seed:3": ["seed:3", "NAME=VALUE"],
    "seed==3": ["seed==3", "Write seed=3"],
    "se ed=3": ["se ed=3", "no name of a setting"],
    "model.hidden_sizes=[16": ["model.hidden_sizes=[16", "a bracket is not closed"],
    "model.hidden_sizes=16]": ["model.hidden_sizes=16]", "a bracket is not opened"],
    "choose={setting:sampler.k": ["choose={setting:sampler.k", "a brace is not closed"],
    "seed=choice(1": ["seed=choice(1", "a parenthesis is not closed"],
    "seed=choice()": ["seed=choice()", "no values"],
    "seed='3": ["seed='3", "a quotation mark (') is not closed"],
    "pretrain.optimizer.lr=0.1,": ["pretrain.optimizer.lr=0.1,", "Write pretrain.optimizer.lr=0.1"],
    "pretrain.optimizer.lr=0,1": ["add -m", "pretrain.optimizer.lr=0.1"],
    "seed=range(3)": ["seed=range(3)", "add -m"],
    "my.label=a;b": ["my.label=a;b", "'my.label=\"a;b\"'"],
    "--seed=3": ["--seed=3", "seed=VALUE"],
    "--multi": ["--multi", "--multirun"],
    "-x": ["-x"],
    "--cfg=jobs": ["--cfg", "'job'"],
    "--config-dir": ["--config-dir", "expected one argument"],
    "--config-name=other": ["--config-name other", "--config-dir FOLDER experiment=NAME"],
    "--config-path=other": ["--config-path other", "--config-dir FOLDER"],
    "--experimental-rerun=x.pickle": ["--experimental-rerun x.pickle", "resume=FOLDER"],
    "--package=model": ["--package model", "add --cfg job"],
    "--resolve": ["--resolve", "add --cfg job"],
    "--shell-completion": ["install=bash"],
    "hydra.run.dir=": ["hydra.run.dir= names no path"],
    "model.weights=''": ["model.weights='' names no path"],
    "problem=~no such user/g.txt": ["problem=~no such user/g.txt", "problem=./~no such user/g.txt"],
    "model.weights=~no such user/w.pt": ["model.weights=~no such user/w.pt"],
    "hydra.run.dir=~no such user/runs": ["hydra.run.dir=~no such user/runs"],
    "problem=glob(*.txt)": ["problem=glob(*.txt)", "matches no file"],
}


@pytest.mark.parametrize("argument", REFUSED, ids=ascii)
def test_refused_in_one_line(argument: str) -> None:
    with pytest.raises(UserError) as refused:
        read([argument])
    message = str(refused.value)
    assert "\n" not in message
    assert "\r" not in message
    for part in REFUSED[argument]:
        assert part in message


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (["seed", "=", "3"], "write seed=3"),
        (["sampler=cd", "seed=", "3"], "write seed=3"),
        (["seed", "=3"], "write seed=3"),
        (["-m", "--cfg", "job"], "one of them at a time"),
        (["--run", "--info"], "one of them at a time"),
        (["--shell-completion", "install=no_shell"], "install=bash"),
    ],
)
def test_refused_together(typed: list[str], meant: str) -> None:
    with pytest.raises(UserError, match=re.escape(meant)):
        read(typed)


@pytest.mark.parametrize(
    ("typed", "setting", "meant"),
    [
        ("seed = 3", "seed", 3),
        (" seed=3 ", "seed", 3),
        ("pretrain.batch_size=None", "pretrain.batch_size", None),
        ("model.weights=None", "model.weights", None),
        ("hydra.run.dir=my runs/a,b", "hydra.run.dir", "my runs/a,b"),
        ("hydra.run.dir='my runs/a,b'", "hydra.run.dir", "my runs/a,b"),
        ("hydra.sweep.dir=it's (1), [2]", "hydra.sweep.dir", "it's (1), [2]"),
        ("hydra.run.dir=runs/${seed}", "hydra.run.dir", "runs/${seed}"),
        ("model.weights=epoch=9-step=99.pt", "model.weights", "epoch=9-step=99.pt"),
        ("data.source.data_dir=K:\\data\\", "data.source.data_dir", "K:\\data\\"),
        ("problem=17", "problem", "17"),
        ("problem=a{b}c.txt", "problem", "a{b}c.txt"),
        ("own.file=fü.txt", "own.file", "fü.txt"),
        ("own.class_weights=[1,2]", "own.class_weights", [1, 2]),
    ],
)
def test_read_as_it_was_meant(typed: str, setting: str, meant: object) -> None:
    line = read([typed])
    (override,) = line.overrides
    assert override.startswith(f"{setting}=")
    assert value(override) == meant
    assert read(line.arguments).overrides == line.overrides


def test_a_tilde_is_somebody_s_folder(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setenv("HOME", str(folder))
    for name in ("problem", "model.weights", "hydra.run.dir", "data.source.data_dir"):
        assert read([f"{name}=~/a b"]).value(name) == f"{folder}/a b"
    (folder / "~here").touch()
    assert read(["problem=~here"]).value("problem") == "~here"


def test_files_of_a_sweep(folder: Path) -> None:
    for name in ("a.txt", "b,c.txt", "d.coo"):
        (folder / name).touch()
    files = r"problem=a.txt,'b,c.txt'"
    assert read(["-m", "problem=glob(*.txt)"]).overrides == (files,)
    assert read(["-m", "problem=glob([*.txt,*.coo],exclude=a*)"]).overrides == ("problem='b,c.txt',d.coo",)
    assert read(["-m", "problem=b,c.txt"]).overrides == ("problem='b,c.txt'",), "a file of the whole name"
    assert read(["problem=glob(a*)"]).overrides == ("problem=a.txt",)
    with pytest.raises(UserError, match="stands for 2 files, the jobs of a sweep: add -m"):
        read(["problem=glob(*.txt)"])


def test_flags_may_stand_anywhere_and_mode_is_a_flag() -> None:
    line = read(["seed=0,1", "-m", "sampler=cd"])
    assert line.multirun
    assert line.overrides == ("seed=0,1", "sampler=cd")
    assert read(["hydra.mode=MULTIRUN", "seed=0,1"]).multirun


def test_every_flag_of_hydra_is_decided_upon() -> None:
    """A new flag of Hydra fails here until it is checked or refused."""
    of_runs = ("run", "multirun", "overrides")
    of_the_configuration = ("config_dir", "package", "resolve")
    before_hydra_is_imported = ("version",)
    of_the_parser = (*of_runs, *of_the_configuration, *before_hydra_is_imported)
    decided = [*arguments.SHOWING, *arguments.REFUSED, *of_the_parser]
    assert sorted(decided) == sorted(action.dest for action in get_args_parser()._actions)


@pytest.mark.parametrize("path", ["a b", "it's", 'say "hi"', "\\", "a\\'b", "x=1,y=[2]", "null", "1e3", "~", "ü"])
def test_paths_in_quotes(path: str) -> None:
    assert value(with_path("hydra.run.dir", path)) == path


def test_relative_paths_are_meant_from_where_they_were_typed(folder: Path) -> None:
    assert value(from_folder("model.weights=first/w.pt", Path("/else where"))) == "/else where/first/w.pt"
    assert from_folder("model.weights=first/w.pt", folder) == "model.weights=first/w.pt"
    for other in ("seed=3", "model.weights=null", "model.weights=/first/w.pt", "hydra.run.dir=${x}", "~problem"):
        assert from_folder(other, Path("/elsewhere")) == other


FLAGS = {
    "--help sampler=cdd": "Did you mean sampler=cd?",
    "-h sampler.k=2": "setting sampler.k",
    "--cfg job samplr=cd": "Did you mean sampler?",
    "--cfg=all seed=3 +sampler=pcd": "Write sampler=pcd",
    "--info all samplr=cd": "Did you mean sampler?",
    "--hydra-help samplr=cd": "'samplr'",
    "--run seed=x": "seed = 'x'",
    "--cfg job --package nothing": "--package nothing",
    "--config-dir nowhere --help": "there is no such folder",
    "hydra.mode=MULTIRUN seed=0,x": "seed = 'x'",
    "-m resume=run": "resume=run goes on with one run, without -m",
    "-m sampler=glob(zz*)": "sampler=glob(zz*) matches nothing",
    "-m seed=glob(zz*)": "seed is none",
    "-m seed=range(0)": "seed=range(0) matches nothing",
}


@pytest.mark.parametrize("typed", FLAGS)
def test_no_flag_leaves_the_checks_behind(memcomp_train: Run, typed: str) -> None:
    outcome = memcomp_train(*shlex.split(typed))
    assert outcome.status == 2
    assert outcome.out == ""
    assert outcome.err.startswith("memcomp-train: ")
    assert outcome.err.count("\n") == 1
    assert FLAGS[typed] in outcome.err
    assert not list(Path.cwd().iterdir()), "a refused command leaves nothing behind"


@pytest.mark.parametrize(
    ("typed", "shown"),
    [
        ("--cfg job --package sampler sampler=pcd", "PCD"),
        ("--cfg hydra", "launcher:"),
        ("--info searchpath", "Search path"),
        ("--hydra-help", "--multirun"),
        ("--shell-completion install=bash", "COMP_LINE"),
        ("--version", f"memcomp-train {__version__}\n"),
        ("-V", f"memcomp-train {__version__}\n"),
    ],
)
def test_flags_that_show_something(memcomp_train: Run, typed: str, shown: str) -> None:
    outcome = memcomp_train(*shlex.split(typed))
    assert outcome.status == 0, outcome.err
    assert shown in outcome.out
    assert not list(Path.cwd().iterdir())


def test_version_of_every_command(memcomp_solve: Run, memcomp_report: Run) -> None:
    assert memcomp_solve("--version").out == f"memcomp-solve {__version__}\n"
    assert memcomp_report("--version").out == f"memcomp-report {__version__}\n"


GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and not path.name.startswith("_"))
NOT_NEEDED = {"control", "experiment", "hparams", "preset"}
"""Groups without settings of their own: they change those of others, or nothing."""


def test_groups_are_added_and_taken_away_in_no_way() -> None:
    assert {"sampler", "data", "experiment"} <= set(GROUPS)
    typed = {f"~{group}": group for group in GROUPS if group not in NOT_NEEDED}
    for group, option in (("sampler", "cd"), ("experiment", "cd1"), ("solver", "dmm")):
        typed |= {f"+{group}={option}": group, f"++{group}={option}": group, f"{group}=3": group}
        typed |= {f"~{group}={option}": group} if group not in NOT_NEEDED else {}
    typed |= {"~seed": "seed", "sampler={k:1}": "sampler", "callbacks=null": "callbacks"}
    with composing():
        for argument, group in typed.items():
            with pytest.raises(UserError, match=re.escape(f"{argument} is not possible: {group} ")):
                _check_options([argument], "config", [])
        for group in ("experiment", "hparams", "control"):
            _check_options([f"~{group}"], "config", [])


KINDS = {
    "model.hidden_sizes=16": "Write model.hidden_sizes=[16]",
    "callbacks.finetune=3": "callbacks.finetune = 3 is not allowed: expected settings by name",
    "pretrain.optimizer=sgd": "pretrain.optimizer._target_",
    "trainer.fast_dev_run=yes": "trainer.fast_dev_run = 'yes' is not allowed: expected an integer, or true",
    "pretrain.iterations=1e3": "pretrain.iterations = 1000.0 is not allowed: expected an integer >= 0. Write 1000",
    "seed=[1]": "seed = [1] is not allowed: expected an integer",
    "~pretrain.iterations": "setting pretrain.iterations is missing",
    "sampler=CD": "Did you mean sampler=cd?",
    "SAMPLER=cd": "Did you mean sampler?",
    "sampler=": "sampler = '' does not exist",
    "model.weights=.": "is a folder",
    "resume=": "resume=FOLDER",
}


@pytest.mark.parametrize("argument", KINDS)
def test_values_of_another_kind(memcomp_train: Run, argument: str) -> None:
    outcome = memcomp_train(*([] if argument.startswith("sampler") else ["sampler=cd"]), argument)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert KINDS[argument] in outcome.err


def test_spellings_of_values(memcomp_train: Run) -> None:
    spelt = ["trainer.fast_dev_run=FALSE", "finetune.batch_size=None", "pretrain.optimizer.lr=1e-2"]
    outcome = memcomp_train(*SHORT, *spelt, "seed = 3", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err


def test_folders_are_called_as_they_like_and_resumed_from_anywhere(
    memcomp_train: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = "my runs/a,b", "it's=[2]"
    assert memcomp_train(*SHORT, f"hydra.run.dir={first}").status == 0
    weights = f"model.weights={first}/weights/pretrain.pt"
    outcome = memcomp_train(*SHORT, weights, f"hydra.run.dir={second}")
    assert outcome.status == 0, outcome.err
    (folder / second / "result.json").unlink()
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    outcome = memcomp_train(f"resume=../{second}")
    assert outcome.status == 0, outcome.err
    assert (folder / second / "result.json").exists()
    assert not list(Path.cwd().iterdir())


def test_paths_are_meant_from_where_the_command_was_typed(memcomp_train: Run, folder: Path) -> None:
    """A job that changes its folder (hydra.job.chdir) finds files, and writes, where a person means it."""
    assert memcomp_train(*SHORT, "hydra.run.dir=first", "hydra.job.chdir=true").status == 0
    weights = "model.weights=first/weights/pretrain.pt"
    outcome = memcomp_train(*SHORT, weights, "hydra.run.dir=a/b", "hydra.job.chdir=true")
    assert outcome.status == 0, outcome.err
    assert "Run folder:   a/b" in outcome.out
    outcome = memcomp_train("-m", *SHORT, weights, "seed=0,1", "hydra.sweep.dir=all", "hydra.job.chdir=true")
    assert outcome.status == 0, outcome.err
    assert len(list(folder.glob("all/*/result.json"))) == 2
    assert folder.samefile(Path.cwd())


def test_settings_of_a_folder_beside_other_search_paths(memcomp_train: Run, folder: Path) -> None:
    for name, text in (("one", "seed: 5"), ("two", "checkpoint_every: 7")):
        (folder / name / "experiment").mkdir(parents=True)
        (folder / name / "experiment" / f"{name}.yaml").write_text(f"# @package _global_\n{text}\n")
    both = ["--config-dir", "one", "hydra.searchpath=[two]"]
    assert memcomp_train(*both, "experiment=two", "seed=x").err.startswith(
        "memcomp-train: seed = 'x' is not allowed"
    )
    outcome = memcomp_train(*both, "experiment=two", *SHORT, "hydra.run.dir=run", "hydra.job.chdir=true")
    assert outcome.status == 0, outcome.err
    assert "checkpoint_every: 7" in Path("run/settings.yaml").read_text()


def test_a_problem_given_by_a_pattern(memcomp_solve: Run, folder: Path) -> None:
    for name in ("one.txt", "two, three.txt"):
        (folder / name).write_text("3 2\n1 2 1\n2 3 1\n")
    sweep = ["-m", "problem=glob(*.txt)", "solver=brute_force", "hydra.sweep.dir=all", "hydra.job.chdir=true"]
    outcome = memcomp_solve(*sweep)
    assert outcome.status == 0, outcome.err
    assert len(list(folder.glob("all/*/solution.json"))) == 2
    refused = memcomp_solve("-m", "problem=glob(*.coo)")
    assert refused.status == 2
    assert refused.err == f"memcomp-solve: problem=glob(*.coo) matches no file in {folder}.\n"
