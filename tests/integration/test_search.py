"""A search judges its trials by held-out images; other launchers; what is refused before the first trial."""

import json
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib.metadata import requires, version
from pathlib import Path
from textwrap import dedent

import pytest
import yaml
from omegaconf import OmegaConf
from running import FAST, Outcome, Program

from memcomp_lightning.configuration.hydra_versions import IS_1_3

Run = Callable[..., Outcome]
SEARCH = ["-m", "hparams=pretraining", "sampler=cd", "callbacks=minimal", *FAST, "hydra.sweep.dir=search"]
PAGE = Path(__file__).parents[2] / "docs/sweeps.md"


def optuna_sweeper() -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")


def quick(*arguments: str) -> list[str]:
    return [*SEARCH, "callbacks.finetune.progress=null", "callbacks.pretrain.progress=null", *arguments]


# Optuna 2 and its sweeper: deprecations of their own.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.usefixtures("allow_global_rng")
def test_search_goes_by_held_out_images_and_the_same_command_goes_on(memcomp_train: Run) -> None:
    optuna_sweeper()
    outcome = memcomp_train(*quick("hydra.sweeper.n_trials=2"))
    assert outcome.status == 0, outcome.err
    found = OmegaConf.load("search/optimization_results.yaml")
    results = [json.loads(path.read_text()) for path in sorted(Path("search").glob("*/result.json"))]
    assert found.best_value == max(result["validation_accuracy"][0] for result in results)
    assert "held-out accuracy" in outcome.out
    written = {path: path.stat().st_mtime_ns for path in Path("search").glob("*/result.json")}
    outcome = memcomp_train(*quick("hydra.sweeper.n_trials=3"))
    assert outcome.status == 0, outcome.err
    assert len(list(Path("search").glob("*/result.json"))) == 3
    assert all(path.stat().st_mtime_ns == time for path, time in written.items())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data.validation_fraction=0"], "data.validation_fraction = 0 is not allowed"),
        (
            ["finetune.iterations=0"],
            "finetune.iterations = 0 is not allowed: expected an integer >= 1 in a search",
        ),
        (["experiment=figure4"], "experiment = 'one of many runs' is not allowed: expected one run in a search"),
        (["pretrain.optimizer.lr=interval(0.1,nan)"], "finite"),
        (["solver.n_restarts=choice(5,0)"], "solver.n_restarts"),
        (["pretrain.rate=interval(0.1,1)"], "setting pretrain.rate (given as pretrain.rate=0.1) does not exist"),
    ],
)
def test_refused_before_the_first_trial(memcomp_train: Run, arguments: list[str], message: str) -> None:
    optuna_sweeper()
    sampler = "sampler=dmm_qubo" if "solver" in arguments[0] else "sampler=cd"
    outcome = memcomp_train("-m", "hparams=pretraining", sampler, *arguments)
    assert outcome.status == 2
    assert message in outcome.err
    assert not Path("multirun").exists()


def test_a_search_is_a_multirun(memcomp_train: Run) -> None:
    outcome = memcomp_train("hparams=pretraining")
    assert (outcome.status, outcome.err) == (2, "memcomp-train: a search is a multirun: add -m.\n")


@pytest.mark.skipif(not IS_1_3, reason="storages work there")
def test_a_storage_that_optuna_cannot_use_is_refused(memcomp_train: Run) -> None:
    optuna_sweeper()
    outcome = memcomp_train(*quick("hydra.sweeper.storage=sqlite:///study.db"))
    assert outcome.status == 2
    assert "hydra.sweeper.storage = 'sqlite:///study.db' is not allowed: optuna 2" in outcome.err


def test_local_submitit_launcher(start_process: Callable[..., Program], tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    own = ["hydra/launcher=submitit_local", "hydra.sweep.dir=sweep"]
    out, errors = start_process("-m", "sampler=cd", "seed=1", "callbacks=minimal", *FAST, *own).communicate()
    assert "1 x 1" in out, errors
    assert "failed" not in out
    assert (tmp_path / "sweep/.submitit").exists()


def test_documented_slurm_settings_compose(
    memcomp_train: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    submitit = pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    assert submitit.__version__
    (block,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    (tmp_path / "confs/hydra/launcher").mkdir(parents=True)
    (tmp_path / "confs/hydra/launcher/cluster.yaml").write_text(block)
    arguments = ["-m", "--config-dir", "confs", "hydra/launcher=cluster", "sampler=cd,pcd"]
    outcome = memcomp_train(*arguments[1:4], "sampler=cd", "--cfg", "hydra")
    assert outcome.status == 0, outcome.err
    launcher = yaml.safe_load(outcome.out)["hydra"]["launcher"]
    assert launcher["_target_"].endswith("SlurmLauncher")
    assert launcher["partition"] == yaml.safe_load(block)["partition"]
    outcome = memcomp_train(*arguments, "sampler.k=0")
    assert outcome.status == 2
    assert "k = 0 is not allowed: expected an integer >= 1." in outcome.err


def test_a_search_path_is_checked_before_training(memcomp_train: Run, tmp_path: Path) -> None:
    (tmp_path / "confs/sampler").mkdir(parents=True)
    (tmp_path / "confs/sampler/warm.yaml").write_text("_target_: memcomp_lightning.samplers.CD\nk: 0\n")
    for path in (
        ["--config-dir", "confs"],
        ["--config-dir=confs"],
        [f"hydra.searchpath=[file://{tmp_path}/confs]"],
    ):
        outcome = memcomp_train(*path, "sampler=warm", "hydra.run.dir=run")
        assert outcome.status == 2
        assert outcome.err == "memcomp-train: sampler: k = 0 is not allowed: expected an integer >= 1.\n"
        assert not Path("run").exists()


HIDDEN = {
    "project/pyproject.toml": """
        [build-system]
        requires = ["setuptools>=64"]
        build-backend = "setuptools.build_meta"
        [project]
        name = "other"
        version = "0"
        [tool.setuptools]
        packages = ["other_conf", "hydra_plugins.other_plugin"]
    """,
    "project/other_conf/__init__.py": "",
    "project/other_conf/word.yaml": "word: found",
    "project/hydra_plugins/other_plugin/__init__.py": """
        from hydra.plugins.search_path_plugin import SearchPathPlugin

        class Other(SearchPathPlugin):
            def manipulate_search_path(self, search_path):
                search_path.append("other", "pkg://other_conf")
    """,
    "conf/by_plugin.yaml": "defaults: [word]",
    "conf/by_path.yaml": "{defaults: [word], hydra: {searchpath: ['pkg://other_conf']}}",
    "program.py": """
        import site, sys
        site.addsitedir(sys.argv.pop(1))
        import hydra

        @hydra.main(config_path="conf", version_base="1.3")
        def main(config):
            print(config.word)

        main()
    """,
}


def test_an_editable_install_hides_a_search_path_plugin_but_no_search_path(tmp_path: Path) -> None:
    """The trap of docs/sweeps.md and its remedy, with a project that setuptools installs in editable mode."""
    for name, text in HIDDEN.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(dedent(text).strip())

    def python(*arguments: str, folder: Path = tmp_path) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)

    build = "from setuptools import build_meta; build_meta.build_editable('..')"
    built = python("-c", build, folder=tmp_path / "project")
    assert built.returncode == 0, built.stderr
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(tmp_path / "site")
    hidden = python("program.py", "site", "--config-name", "by_plugin")
    assert hidden.returncode != 0
    assert "Could not load 'word'" in hidden.stderr
    found = python("program.py", "site", "--config-name", "by_path")
    assert found.stdout == "found\n", found.stderr
    # As a plain folder on the path, the plugin is seen: it is the install that hides it.
    (tmp_path / "site/__editable__.other-0.pth").write_text(f"{tmp_path / 'project'}\n")
    assert python("program.py", "site", "--config-name", "by_plugin").stdout == "found\n"


def test_no_extra_pins_cloudpickle() -> None:
    """hydra-ray-launcher does, to one version."""
    assert not [line for line in requires("memcomp-lightning") or [] if re.match(r"(cloudpickle|ray)\b", line)]
    assert version("hydra-core")
