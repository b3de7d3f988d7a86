"""Runs of ``memcomp-train data=sequences``: the page's commands, weights, missing letters, and what is refused."""

import json
import re
import shlex
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
import torch
from running import QUIET, Outcome

import memcomp_lightning
from memcomp_lightning.data import Sequences, TableDataModule
from memcomp_lightning.models import DBN, BoltzmannMachine, independent_bias
from memcomp_lightning.models.units import Categorical

pytest.importorskip("Bio")

PAGE = (Path(__file__).parents[2] / "docs/sequences.md").read_text()
FAMILY, SHOWN = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)[:2]
COMMANDS = [shlex.split(line, comments=True) for line in re.findall(r"^memcomp-train .*$", PAGE, re.MULTILINE)]

Train = Callable[..., Outcome]


@pytest.fixture
def family(memcomp_train: Train) -> Path:
    """The alignment of the page, in the folder in which the command runs."""
    path = Path("family.fasta")
    path.write_text(FAMILY)
    return path


def test_commands_of_the_page(memcomp_train: Train, run_command: Callable[..., Outcome], family: Path) -> None:
    assert len(COMMANDS) == 2
    outcomes = [memcomp_train(*arguments, *QUIET) for _, *arguments in COMMANDS]
    assert [outcome.status for outcome in outcomes] == [0, 0], [outcome.err for outcome in outcomes]
    assert SHOWN in outcomes[0].out
    assert "weights     none" in outcomes[1].out
    run = memcomp_lightning.load("family")
    assert run.schema is not None
    assert run.model.b.shape == (60,)
    assert run.schema.read(family).v.shape == (10, 12)
    potts = memcomp_lightning.load("potts")
    assert potts.model.n_hidden == 0
    whole = Path("whole.fasta")
    whole.write_text(">new\nGAUUACA-CUGA\n")
    main = import_module("memcomp_lightning.cli.transform").main
    found = run_command("memcomp-transform", main, ("family", "whole.fasta", "output=features.csv"))
    assert found.status == 0, found.err
    names, row = (line.split(",") for line in Path("features.csv").read_text().splitlines())
    assert names[:2] == ["name", "h1"]
    assert row[0] == "new"
    scored = run_command(
        "memcomp-score", import_module("memcomp_lightning.cli.score").main, ("potts", "whole.fasta")
    )
    assert scored.status == 0, scored.err
    assert Path("scores.csv").read_text().splitlines()[1].startswith("1,new,-")


def test_sites_are_coupled_along_the_edges_of_a_file(memcomp_train: Train, family: Path) -> None:
    edges = Path("contacts.csv")
    edges.write_text("".join(f"{k},{11 - k}\n" for k in range(6)))
    settings = ["data=sequences", "data.path=family.fasta", "model=bonds", "model.connectivity.path=contacts.csv"]
    found = memcomp_train(*settings, *QUIET, "pretrain.iterations=1", "hydra.run.dir=run")
    assert found.status == 0, found.err
    edges.unlink()
    model = memcomp_lightning.load("run").model
    assert isinstance(model, BoltzmannMachine)
    sites = model.visible.site_of()[model.pairs]
    assert len(sites) == 6 * 5 * 5
    assert sites.sum(-1).unique().tolist() == [11]


def test_first_biases_are_those_of_the_weighted_letters(memcomp_train: Train, family: Path) -> None:
    settings = ["data=sequences", "data.path=family.fasta", "model.hidden_sizes=[2]", *QUIET]
    still = ["pretrain.iterations=1", "pretrain.optimizer.lr=0.0", "hydra.run.dir=run"]
    assert memcomp_train(*settings, *still).status == 0
    network = memcomp_lightning.load("run").network
    assert isinstance(network, DBN)
    some = TableDataModule(Sequences(path="family.fasta").load()).some_train()
    units = network[0].visible
    assert isinstance(units, Categorical)
    expected = independent_bias(some.v, units, some.observed, some.weight)
    torch.testing.assert_close(network[0].b.detach(), expected)
    assert not expected.allclose(independent_bias(some.v, units, some.observed), atol=0.05)


def test_sequences_with_missing_letters_are_judged_by_the_known_ones(memcomp_train: Train, family: Path) -> None:
    settings = ["data=sequences", "data.path=family.fasta", "data.test=family.fasta", *QUIET]
    measured = "+callbacks.pretrain.log_likelihood={_target_: memcomp_lightning.callbacks.LogLikelihood}"
    found = memcomp_train(
        *settings, "model.hidden_sizes=[3]", "pretrain.iterations=60", measured, "hydra.run.dir=run"
    )
    assert found.status == 0, found.err
    result = json.loads(Path("run/result.json").read_text())
    (last,) = result["stages"]["pretrain"]["log_likelihood"][-1]["heldout"]
    assert result["context"]["independent_units"]["heldout"] < last < 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["data=sequences"], "type data.path=FILE, as in data.path=family.fasta"),
        (["data=sequences", "data.path=none.fasta"], "none.fasta: there is no such file"),
        (
            ["data=sequences", "data.path=family.fasta", "data.alphabet=protein"],
            "line 2: 'U' is no letter of protein",
        ),
        (
            ["data=sequences", "data.path=family.fasta", "data.similarity=80"],
            "data.similarity = 80 is not allowed",
        ),
        (["data=sequences", "data.path=family.fasta", "data.partitions=2"], "type data.similarity=null"),
        (["data=sequences", "data.path=family.fasta", "units=spin"], "units = "),
        (
            ["data=sequences", "data.path=family.fasta", "choose={setting: sampler.k, values: [1, 2]}"],
            "choose.setting = 'sampler.k' is not allowed: expected null where the data have no labels",
        ),
    ],
)
def test_mistakes(memcomp_train: Train, family: Path, settings: list[str], message: str) -> None:
    found = memcomp_train(*settings)
    assert found.status == 2
    assert message in found.err
    assert "Traceback" not in found.err
