"""The campaigns of kills and faults find nothing in a sound run, and find what is damaged."""

import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("pyarrow")
sys.path.append(str(Path(__file__).parents[1] / "campaigns"))

import faults
import kills
import kinds_of_run
from kinds_of_run import KINDS

pytestmark = pytest.mark.xdist_group("campaigns")  # one worker, one uninterrupted run of each kind


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("campaign")


def test_kinds_are_mixed_by_their_weights() -> None:
    cases = kills.cases(1000)
    assert len(set(cases)) == 1000
    assert {case.split("/")[0] for case in cases} == set(KINDS)
    assert {case.split("/")[0] for case in faults.cases(100)} == set(faults.FAULTS)


@pytest.mark.parametrize("case", ["machine/1", "sampling/3"])
def test_a_killed_run_goes_on_to_the_same_bits(folder: Path, case: str) -> None:
    outcome = kills.attempt(case, folder=folder)
    assert (outcome.kind, outcome.findings) == (case.split("/")[0], [])
    assert outcome.tried >= 1
    assert not list(folder.glob("case_*"))


@pytest.mark.parametrize("case", ["SIGTERM/machine/7", "clock set back/machine/0"])
def test_a_fault_is_told_with_the_command_that_goes_on(folder: Path, case: str) -> None:
    outcome = faults.attempt(case, folder=folder)
    assert (outcome.tried, outcome.findings) == (1, [])


def damaged(run: Path, name: str) -> None:
    if name == "weights":
        path = run / "weights/pretrain.pt"
        tensors = torch.load(path, weights_only=True)
        first = next(iter(tensors.values())).view(-1)
        first[0] = torch.nextafter(first[0], torch.tensor(9.0))
        torch.save(tensors, path)
    elif name == "result":
        result = json.loads((run / "result.json").read_text())
        result["stages"]["pretrain"]["energy_gap"] = []
        (run / "result.json").write_text(json.dumps(result))
    elif name == "missing":
        (run / "weights/pretrain_chains.pt").unlink()
    else:
        (run / ".a.json.here.1.partial").touch()


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("weights", "a tensor of other values"),
        ("result", "energy_gap has 0 entries, not 1"),
        ("missing", "run/weights/pretrain_chains.pt is missing"),
    ],
)
def test_what_differs_is_found(folder: Path, tmp_path: Path, name: str, told: str) -> None:
    """By one bit of one weight, too."""
    place, _ = kills.whole(KINDS["machine"], folder)
    shutil.copytree(place / "second", tmp_path / "here")
    assert kinds_of_run.difference(tmp_path / "here", place / "first") is None
    damaged(tmp_path / "here/run", name)
    assert told in (kinds_of_run.difference(tmp_path / "here", place / "first") or "")


def test_a_damaged_result_is_a_finding_with_kind_seed_and_moment(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, damage = kinds_of_run.live, ["weights"]

    def then_damaged(
        command: str, arguments: tuple[str, ...], here: Path, **settings: object
    ) -> kinds_of_run.Ended:
        ended = live(command, arguments, here, **settings)  # type: ignore[arg-type]
        if ended.status == 0:
            damaged(here / "run", damage.pop())
        return ended

    monkeypatch.setattr(kills, "live", then_damaged)
    (finding,) = kills.attempt("machine/1", folder=folder).findings
    assert re.match(
        r"machine, seed 1, killed (before|after) .*: differed: run/weights/pretrain.pt: .* of other", finding
    )
    damage.append("partial")
    (finding,) = kills.attempt("machine/1", folder=folder).findings
    assert "left: 1 files that were not finished, such as run/.a.json.here.1.partial" in finding


def test_a_command_that_does_not_go_on_is_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kinds_of_run.Kind, "goes_on", lambda *_: ("train", ("resume=nothing",)))
    (finding,) = kills.attempt("machine/1", folder=folder).findings
    assert "refused to go on: memcomp-train resume=nothing ended with 2" in finding


def test_a_message_without_its_command_is_found(tmp_path: Path) -> None:
    place = kinds_of_run.Ended(0, "", "", 1.0)
    case = faults.Case("memory", KINDS["machine"], faults.random.Random(0), tmp_path, place, tmp_path)
    assert case.heard(kinds_of_run.Ended(1, "", "Traceback\nMemoryError", 1.0))
    assert [finding.split(": ")[1] for finding in case.findings] == [
        "a traceback",
        "no command that goes on is named",
    ]
