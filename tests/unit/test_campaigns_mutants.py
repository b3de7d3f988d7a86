"""The campaign of mutants sees a mutant that a test kills, one that no test sees, and one that hangs."""

import sys
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray")
pytest.importorskip("coverage")
sys.path.append(str(Path(__file__).parents[1] / "campaigns"))

import forked_tests
import mutants
from mutations import Mutant, is_python

THING = """
def larger(a: int | None, b: int) -> int:
    return a if a > b else b

def halvings(n):
    if n < 0:
        raise ValueError(f"{n + 1} is below", n + 2)
    times = 0
    while n > 0:
        n, times = n // 2, times + 1
    return times
"""
TESTS = """
from thing import halvings, larger

def test_larger():
    assert larger(2, 1) == 2

def test_halvings():
    assert halvings(4) == 3
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tree = tmp_path_factory.mktemp("tree")
    (tree / "thing.py").write_text(THING)
    (tree / "test_thing.py").write_text(TESTS)
    (tree / "pytest.ini").write_text("[pytest]\n")
    return tree


@pytest.fixture(scope="module")
def known(tree: Path) -> mutants.Map:
    found = forked_tests.in_a_fork(
        lambda: forked_tests.mapped(tree, "test_thing.py", ["thing.py"]), seconds=60, log=tree / "log"
    )
    assert found["bad"] == []
    mutants.write(found, tree / "map.json")
    return mutants.Map([tree / "map.json"])


def one(operator: str, line: int) -> Mutant:
    [found] = [m for m in mutants.mutants(THING) if (m.operator, m.line) == (f"core/{operator}", line)]
    return found


@pytest.mark.parametrize(
    ("operator", "line", "outcome", "tests"),
    [
        ("ReplaceComparisonOperator_Gt_Lt", 3, "killed", 1),
        ("ReplaceComparisonOperator_Gt_GtE", 3, "survived", 1),
        ("ReplaceComparisonOperator_Gt_GtE", 9, "killed by time", 1),
        ("ReplaceBinaryOperator_Add_Sub", 7, "not covered", 0),
    ],
)
def test_what_becomes_of_a_mutant(
    monkeypatch: pytest.MonkeyPatch,
    tree: Path,
    known: mutants.Map,
    operator: str,
    line: int,
    outcome: str,
    tests: int,
) -> None:
    monkeypatch.setattr(mutants, "START", 1 if outcome == "killed by time" else 60)
    (tree / "logs").mkdir(exist_ok=True)
    found = mutants.tried(one(operator, line), tree / "thing.py", tree=tree, known=known, folder=tree)
    assert (found["outcome"], found["tests"]) == (outcome, tests)
    assert (tree / "thing.py").read_text() == THING


def test_annotations_and_messages_are_left_alone() -> None:
    lines = {mutant.line for mutant in mutants.mutants(THING)}
    assert 2 not in lines
    assert lines >= {3, 6, 7, 8, 9, 10}
    one("ReplaceBinaryOperator_Add_Sub", 7)  # there is one, beside that of the message


def test_the_table_counts() -> None:
    facts = [("models", "killed"), ("models", "killed by time"), ("problems", "survived"), ("models", "survived")]
    said = mutants.table({"kind": kind, "facts": {"outcome": outcome}} for kind, outcome in facts)
    assert said.splitlines()[2:] == [
        "| models | 3 | 1 | 1 | 1 | 0 | 66.7% |",
        "| problems | 1 | 0 | 0 | 1 | 0 | 0.0% |",
        "| all | 4 | 1 | 1 | 2 | 0 | 50.0% |",
    ]


def test_the_sample_is_seeded_and_python(tmp_path: Path) -> None:
    folder = tmp_path / "memcomp_lightning/models"
    folder.mkdir(parents=True)
    text = "def total(a, *, b):\n    return a + b\n"
    (folder / "thing.py").write_text(text)
    every = [*mutants.mutants(text)]
    cases = mutants.sample(tmp_path, len(every))
    assert cases[:5] == mutants.sample(tmp_path, 5)
    assert 5 < len(cases) == sum(is_python(mutant.of(text)) for mutant in every) < len(every)
    assert {case.rpartition("/")[0] for case in cases} >= {"models/thing.py:2/ReplaceBinaryOperator_Add_Sub"}
