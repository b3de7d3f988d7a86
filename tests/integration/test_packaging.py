"""The wheel carries its configuration, and another Hydra project reaches it."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import memcomp_lightning

pytestmark = pytest.mark.xdist_group("wheel")  # one worker, one wheel

ROOT = Path(memcomp_lightning.__file__).parents[1]

DOWNSTREAM = """
import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig

import memcomp_lightning

@hydra.main(config_path="conf", config_name="config", version_base="1.3")
def main(config: DictConfig) -> None:
    print(memcomp_lightning.__file__, instantiate(config.sampler).solver.max_steps, config.own_setting)

main()
"""


def run(*command: str, folder: Path, path: Path | None = None) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel installed, without its dependencies, in a folder that comes before the checkout on the path."""
    folder = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "pip", "install", "--no-deps", "--target", str(folder), str(wheel), folder=folder)
    return folder


def test_wheel_holds_every_config_and_the_type_marker(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    expected = {
        f"memcomp_lightning/conf/{path.relative_to(ROOT / 'conf')}" for path in ROOT.glob("conf/**/*.yaml")
    }
    assert expected <= names
    assert "memcomp_lightning/conf/__init__.py" in names
    assert "memcomp_lightning/py.typed" in names
    # No plugin, which a setuptools editable install of another project would hide: see docs/sweeps.md.
    assert not [
        name for name in names if name.startswith(("tests", "conf/", "docs", "site", "mkdocs", "hydra_plugins"))
    ]


def test_one_version_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert re.fullmatch(r"\d+\.\d+\.\d+((a|b|rc)\d+)?", project["version"])
    assert project["version"] == memcomp_lightning.__version__ == citation["version"]
    assert project["license"] == citation["license"]
    # What the schema of version 1.2.0 requires, and its two kinds of authors.
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= citation.keys()
    for work in (citation, *citation["references"]):
        assert all(
            "name" in author or {"family-names", "given-names"} <= author.keys() for author in work["authors"]
        )
    assert all({"type", "title"} <= reference.keys() for reference in citation["references"])
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert changelog.count("## [Unreleased]") == 1
    # Of a version under way, such as 0.4.0a1, there is no heading yet.
    if re.fullmatch(r"[\d.]+", project["version"]):
        assert f"## [{project['version']}] - {citation['date-released']}\n" in changelog


def test_the_pythons_of_the_metadata_are_those_of_ci() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    told = [line.rpartition(" ")[2] for line in project["classifiers"] if "Python :: 3." in line]
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    assert workflow["jobs"]["test"]["strategy"]["matrix"]["python"] == told
    assert project["requires-python"] == f">={told[0]}"


@pytest.mark.parametrize("from_wheel", [True, False], ids=["wheel", "editable"])
def test_another_project_composes_our_groups(installed: Path, tmp_path: Path, from_wheel: bool) -> None:
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf/config.yaml").write_text(
        "defaults: [{solver: dmm}, {sampler: dmm_qubo}, _self_]\n"
        "own_setting: 7\n"
        "hydra: {searchpath: ['pkg://memcomp_lightning.conf']}\n"
    )
    (tmp_path / "project.py").write_text(DOWNSTREAM)
    out = run(
        sys.executable,
        "project.py",
        "solver.max_steps=77",
        folder=tmp_path,
        path=installed if from_wheel else None,
    )
    assert out.split()[1:] == ["77", "7"]
    assert (str(installed) in out) == from_wheel
