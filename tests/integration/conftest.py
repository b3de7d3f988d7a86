"""Ways to run the command line: in this process where that is enough, as a real process where it is not."""

import copy
import functools
import logging
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import jaxtyping
import lightning.fabric.utilities.registry as lightning_registry
import omegaconf.base
import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.hydra import Hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import JobRuntime
from omegaconf import DictConfig, OmegaConf
from running import Outcome, Program, end_warm_pythons, launch

import memcomp_lightning
from memcomp_lightning.cli import report, solve, sweep, train

OURS = [("pkg", "hydra.conf"), ("pkg", "memcomp_lightning.conf"), ("structured", "")]
"""Sources of configurations that no test changes."""


@pytest.fixture(scope="session", autouse=True)
def _composed_once() -> Iterator[None]:
    """Keep what Hydra reads and composes of our own files: some thousand times a quarter of a second."""
    compose, get_mode = ConfigLoaderImpl._load_configuration_impl, Hydra.get_mode
    read = ConfigRepository.load_config
    kept: dict[tuple[Any, ...], bytes] = {}

    def load_config(repository: ConfigRepository, config_path: str) -> Any:
        sources = sorted((source.scheme(), source.path) for source in repository.get_sources())
        if sources != OURS:
            return read(repository, config_path)
        key = ("file", config_path)
        if key not in kept:
            kept[key] = pickle.dumps(read(repository, config_path))
        return pickle.loads(kept[key])

    def composed(
        loader: ConfigLoaderImpl, config_name: str | None, overrides: list[str], *args: Any, **kwargs: Any
    ) -> DictConfig:
        sources = sorted((source.scheme(), source.path) for source in loader.repository.get_sources())
        if sources != OURS or any("hydra.searchpath" in override for override in overrides):
            return compose(loader, config_name, overrides, *args, **kwargs)
        key = (config_name, *overrides, args, *kwargs.items(), JobRuntime.instance().conf.name)
        if key not in kept:
            kept[key] = pickle.dumps(compose(loader, config_name, overrides, *args, **kwargs))
        config: DictConfig = pickle.loads(kept[key])
        OmegaConf.clear_cache(config)  # which time it was
        config.hydra.runtime.cwd = str(Path.cwd())
        return config

    def mode(hydra: Hydra, config_name: str | None, overrides: list[str]) -> Any:
        """Of the command line: composed again only where it may be set."""
        return get_mode(hydra, config_name, overrides) if any("hydra.mode" in o for o in overrides) else None

    def copied(repository: ConfigRepository, memo: dict[int, Any]) -> ConfigRepository:
        """Sources do not change; which of them are looked in may."""
        other = copy.copy(repository)
        other.sources = list(repository.sources)
        return other

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConfigRepository, "__deepcopy__", copied, raising=False)
        patch.setattr(omegaconf.base, "parse", functools.cache(omegaconf.base.parse))
        patch.setattr(lightning_registry, "entry_points", functools.cache(entry_points))
        patch.setattr(ConfigLoaderImpl, "_load_configuration_impl", composed)
        patch.setattr(ConfigRepository, "load_config", load_config)
        patch.setattr(Hydra, "get_mode", mode)
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_process_is_left() -> Iterator[None]:
    yield
    end_warm_pythons()


@pytest.fixture(autouse=True)
def _shapes_unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exact and unit tests check them; here they would take a sixth of the time."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


RunCommand = Callable[[str, Callable[[], None], tuple[str, ...]], Outcome]


@pytest.fixture
def run_command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> RunCommand:
    """Run a command in this process, in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, main: Callable[[], None], arguments: tuple[str, ...]) -> Outcome:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        monkeypatch.setattr(sweep.RememberSweepFolder, "folder", None)
        GlobalHydra.instance().clear()
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 1
        captured = capfd.readouterr()
        _forget_log_handlers()
        return Outcome(status, captured.out, captured.err)

    return run


def _forget_log_handlers() -> None:
    """Take away Hydra's handlers, whose streams are those of this test."""
    root = logging.getLogger()
    for handler in [h for h in root.handlers if type(h) in (logging.StreamHandler, logging.FileHandler)]:
        root.removeHandler(handler)
        handler.close()


@pytest.fixture
def memcomp_train(run_command: RunCommand) -> Callable[..., Outcome]:
    """Run ``memcomp-train`` in this process, in a folder of its own."""
    return lambda *arguments: run_command("memcomp-train", train.main, arguments)


@pytest.fixture
def memcomp_solve(run_command: RunCommand) -> Callable[..., Outcome]:
    """Run ``memcomp-solve`` in this process, in a folder of its own."""
    return lambda *arguments: run_command("memcomp-solve", solve.main, arguments)


@pytest.fixture
def memcomp_report(run_command: RunCommand) -> Callable[..., Outcome]:
    """Run ``memcomp-report`` in this process, in a folder of its own."""
    return lambda *arguments: run_command("memcomp-report", report.main, arguments)


@pytest.fixture
def start_process(tmp_path: Path) -> Callable[..., Program]:
    """Start ``memcomp-train`` in the test's folder."""

    def start(*arguments: str) -> Program:
        return launch(*arguments, folder=tmp_path)

    return start


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Our wheel, by way of the source archive, as an index or a packager would build it."""
    folder, root = tmp_path_factory.mktemp("wheel"), Path(memcomp_lightning.__file__).parents[1]
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, root]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(folder.glob("*.whl"))


@pytest.fixture
def joblib_launcher() -> Iterator[list[str]]:
    """Overrides that choose it; its processes, which stay in the folder of the test, end with the test."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    loky = pytest.importorskip("joblib.externals.loky")
    yield ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    loky.get_reusable_executor().shutdown(wait=True)
