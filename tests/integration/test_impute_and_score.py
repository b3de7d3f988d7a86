"""``memcomp-impute`` and ``memcomp-score``: a trained run, a table, and what may be wrong with both."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from running import QUIET, Outcome, launch

from memcomp_lightning import rng
from memcomp_lightning.cli import impute, score
from memcomp_lightning.cli.commands import score as score_command
from memcomp_lightning.errors import UserError
from memcomp_lightning.trained import load
from memcomp_lightning.trained.training_rows import training_rows

Command = Callable[..., Outcome]

ROWS = 300


def people() -> pd.DataFrame:
    """Colour and height follow the sex, and so does the class."""
    draw = rng.numpy_stream(0, "people")
    female = draw.random(ROWS) < 0.5
    return pd.DataFrame(
        {
            "id": [f"{k:03d}" for k in range(ROWS)],
            "age": draw.integers(20, 60, ROWS),
            "sex": np.where(female, "f", "m"),
            "height": np.where(female, 160.0, 180.0) + 4 * draw.standard_normal(ROWS),
            "colour": np.where(draw.random(ROWS) < 0.9, np.where(female, "red", "blue"), "green"),
            "species": np.where(female, "cat", "dog"),
        }
    )


def gappy() -> pd.DataFrame:
    """Texts, as they are to stand in the file, with a fifth of the cells of the model empty and a row of gaps."""
    table = people().astype({"age": str}).astype({"height": str})
    for name in ("age", "sex", "height", "colour"):
        table.loc[rng.numpy_stream(1, name).random(ROWS) < 0.2, name] = ""
    table.loc[7, ["age", "sex", "height", "colour"]] = ""
    return table


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    people().to_csv(folder / "people.csv", index=False)
    train = [
        *("data=table", "data.path=people.csv", "data.columns={label:species,id:ignore}"),
        *(
            "model.hidden_sizes=[14]",
            "pretrain.iterations=40",
            "pretrain.batch_size=10",
            "pretrain.optimizer.lr=0.1",
            "finetune.iterations=10",
        ),
        *(*QUIET, "hydra.run.dir=run"),
    ]
    program = launch(*train, folder=folder)
    out, err = program.communicate()
    assert program.returncode == 0, out + err
    return folder / "run"


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> str:
    """The run, in the folder of the test, with a table beside it."""
    shutil.copytree(trained, tmp_path / "run")
    gappy().to_csv(tmp_path / "gaps.csv", index=False)
    people().to_csv(tmp_path / "people.csv", index=False)
    return "run"


@pytest.fixture
def memcomp_impute(run_command: Any) -> Command:
    return lambda *arguments: run_command("memcomp-impute", impute.main, arguments)


@pytest.fixture
def memcomp_score(run_command: Any) -> Command:
    return lambda *arguments: run_command("memcomp-score", score.main, arguments)


def read(path: str) -> pd.DataFrame:
    return pd.read_csv(path, dtype=str, keep_default_na=False)


def test_the_gaps_are_filled_and_nothing_else_changes(memcomp_impute: Command, run: str) -> None:
    outcome = memcomp_impute(run, "gaps.csv", "probabilities=sure.csv")
    assert outcome.status == 0, outcome.err
    before, after, sure = gappy(), read("filled.csv"), read("sure.csv")
    assert list(after.columns) == list(before.columns)
    empty = before == ""
    assert (after == before).to_numpy()[~empty.to_numpy()].all()
    assert not (after == "").any(axis=None)
    assert set(after["colour"]) == {"red", "blue", "green"}
    assert after["age"].str.fullmatch(r"\d+").all()
    assert f"{int(empty.sum().sum())} gaps in {int(empty.any(axis=1).sum())} of 300 rows filled" in outcome.out
    assert "rows by Gibbs chains (R-hat at most 1.0" in outcome.out
    assert "written: filled.csv, sure.csv" in outcome.out
    # The model knows that women are shorter here, and what it is sure of is mostly so.
    truth = people()
    sex = empty["sex"] & ~empty["height"]
    assert (after["sex"] == truth["sex"])[sex].mean() > 0.9
    assert list(sure.columns) == ["row", "column", "value", "probability", "deviation", "low", "high"]
    assert len(sure) == int(empty.sum().sum())
    for _, gap in sure.iterrows():
        assert after.loc[int(gap["row"]) - 1, gap["column"]] == gap["value"]
    real = sure[sure["column"] == "height"]
    low, high = real["low"].astype(float), real["high"].astype(float)
    within = (truth["height"][real["row"].astype(int) - 1].to_numpy() >= low) & (
        truth["height"][real["row"].astype(int) - 1].to_numpy() <= high
    )
    assert within.mean() > 0.75
    assert (real["probability"] == "").all()
    assert sure[sure["column"] == "sex"]["probability"].astype(float).between(0.5, 1).all()


def test_draws_differ_where_something_was_missing(memcomp_impute: Command, run: str) -> None:
    outcome = memcomp_impute(run, "gaps.csv", "m=2", "output=drawn.csv", "seed=3")
    assert outcome.status == 0, outcome.err
    first, second, empty = read("drawn-1.csv"), read("drawn-2.csv"), gappy() == ""
    assert not Path("drawn.csv").exists()
    assert (first == second).to_numpy()[~empty.to_numpy()].all()
    assert 0.3 < (first != second).to_numpy()[empty.to_numpy()].mean() < 1
    assert memcomp_impute(run, "gaps.csv", "m=2", "output=again.csv", "seed=3").status == 0
    assert read("again-2.csv").equals(second)


def test_columns_that_are_not_there_are_filled_in_whole(memcomp_impute: Command, run: str) -> None:
    read("people.csv").drop(columns=["sex", "age"]).to_parquet("some.parquet")
    outcome = memcomp_impute(run, "some.parquet", "output=all.parquet")
    assert outcome.status == 0, outcome.err
    assert "columns without any value, or not in the file: sex, age" in outcome.out
    found = pd.read_parquet("all.parquet")
    assert list(found.columns) == ["id", "height", "colour", "species", "age", "sex"]
    assert (found["sex"] == people()["sex"]).mean() > 0.9


def test_rows_are_scored(memcomp_score: Command, run: str) -> None:
    outcome = memcomp_score(run, "gaps.csv")
    assert outcome.status == 0, outcome.err
    found, whole = pd.read_csv("scores.csv"), ~(gappy() == "").any(axis=1)
    names = [
        "row",
        "id",
        "species",
        "log_likelihood",
        "free_energy",
        "pseudo_log_likelihood",
        "p(cat)",
        "p(dog)",
        "class",
    ]
    assert list(found.columns) == names
    assert found["row"].tolist() == list(range(1, ROWS + 1))
    assert read("scores.csv")[["id", "species"]].equals(people()[["id", "species"]])
    assert found[["log_likelihood", "free_energy"]].notna().all(axis=None)
    assert found["pseudo_log_likelihood"].notna().equals(whole)
    assert found[names[6:]].notna().all(axis=None)
    assert found["log_likelihood"][7] == pytest.approx(0, abs=1e-4)  # nothing of it is known
    right = found["class"] == people()["species"]
    assert f"accuracy on labelled rows: {right.mean():.4f}" in outcome.out
    assert right[whole].mean() > 0.9
    assert right[~whole].mean() > 0.8
    assert f"classes of {int((~whole).sum())} rows with gaps: means over 100 draws" in outcome.out
    assert "exact, " in outcome.out
    mean = found["log_likelihood"].mean()
    assert f"mean log-likelihood {mean:.4f} ± " in outcome.out
    # Rows that are like no others are less likely.
    odd = people().iloc[:20].copy()
    odd["height"] = 340 - odd["height"]
    odd.to_csv("odd.csv", index=False)
    assert memcomp_score(run, "odd.csv", "output=odd_scores.csv").status == 0
    assert memcomp_score(run, "people.csv", "output=usual_scores.csv").status == 0
    odd_scores, usual = pd.read_csv("odd_scores.csv"), pd.read_csv("usual_scores.csv").iloc[:20]
    assert odd_scores["log_likelihood"].mean() < usual["log_likelihood"].mean() - 2


def test_the_figure_shows_rows_data_and_samples(
    memcomp_score: Command, run: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[list[str]] = []

    def write(figures: Any, output: Path, *, overwrite: bool) -> None:
        (axes,) = figures["likelihoods"].axes
        drawn.append([text.get_text() for text in axes.get_legend().get_texts()])

    monkeypatch.setattr(score_command, "write_figures", write)
    outcome = memcomp_score(run, "gaps.csv", "figures=looks.png")
    assert outcome.status == 0, outcome.err
    n_gaps = int((gappy() == "").any(axis=1).sum())
    assert f"the figure leaves out {n_gaps} rows with gaps, whose likelihoods are of fewer values" in outcome.out
    assert [text.partition(", mean ")[0] for text in drawn[0]] == [
        *("training data", "samples", "held-out data", "rows of gaps.csv")
    ]
    whole = ~(gappy() == "").any(axis=1)
    mean = pd.read_csv("scores.csv")["log_likelihood"][whole].mean()
    assert drawn[0][3].endswith(f"mean {mean:.4g}")
    # A run that was moved, whose data are gone.
    settings = json.loads(Path("run/overrides.json").read_text())
    Path("run/overrides.json").write_text(json.dumps({**settings, "folder": "/nowhere"}))
    outcome = memcomp_score(run, "people.csv", "figures=looks.png", "overwrite=true")
    assert outcome.status == 0, outcome.err
    assert "the figure leaves out the data of the run: /nowhere/people.csv: there is no such file\n" in outcome.out
    assert [text.partition(", mean ")[0] for text in drawn[1]] == ["rows of people.csv", "samples"]


def test_the_data_of_a_run_are_read_again(run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    loaded = load(run)
    found = training_rows(loaded)
    assert (found.train.n, found.heldout.n) == (243, 27)
    both = torch.cat((found.train.v, found.heldout.v))
    everybody = loaded.needed_schema.read(Path("people.csv")).v
    assert {tuple(row) for row in both.tolist()} <= {tuple(row) for row in everybody.tolist()}
    assert training_rows(loaded, most=100).train.n == 81
    path = Path("run/settings.yaml")
    path.write_text(path.read_text().replace("memcomp_lightning.data.Table", "os.system"))
    with pytest.raises(
        UserError, match=r"data\.source is os\.system, which is no part of a model of this package"
    ):
        training_rows(loaded)


def test_a_column_with_the_name_of_a_score_is_left_out_and_that_is_said(memcomp_score: Command, run: str) -> None:
    people().rename(columns={"species": "class", "id": "row"}).to_csv("other.csv", index=False)
    outcome = memcomp_score(run, "other.csv")
    assert outcome.status == 0, outcome.err
    assert "left out of the table's columns, as what was found has this name: 'row', 'class'" in outcome.out
    found = pd.read_csv("scores.csv")
    assert list(found.columns)[:2] == ["row", "log_likelihood"]
    assert found["row"][0] == 1
    assert set(found["class"]) == {"cat", "dog"}


def test_a_misspelt_column_is_said(memcomp_score: Command, run: str) -> None:
    people().rename(columns={"age": "Age"}).to_csv("other.csv", index=False)
    outcome = memcomp_score(run, "other.csv")
    assert outcome.status == 0, outcome.err
    assert "columns without any value, or not in the file: age\n" in outcome.out


def change(name: str, row: int, value: str) -> None:
    table = read("gaps.csv")
    table.loc[row, name] = value
    table.to_csv("gaps.csv", index=False)


def unfinished() -> None:
    shutil.rmtree("run/weights")


def older() -> None:
    Path("run/schema.json").unlink()


WRONG: dict[str, tuple[list[str], Callable[[], object] | None, str]] = {
    "no table": (["run", "nothing.csv"], None, "nothing.csv: there is no such file."),
    "no run": (["runs", "gaps.csv"], None, "runs"),
    "unfinished": (["run", "gaps.csv"], unfinished, "run has no trained weights yet: go on with memcomp-train"),
    "without a schema": (["run", "gaps.csv"], older, "run has no schema.json"),
    "one place": (["run"], None, "TABLE is missing before the settings: type memcomp-"),
    "an unknown word": (
        ["run", "gaps.csv"],
        lambda: change("colour", 4, "mauve"),
        "gaps.csv, column 'colour', row 5: 'mauve' is not allowed: expected one of the values of the training "
        "data: blue, green, red.",
    ),
    "no number": (
        ["run", "gaps.csv"],
        lambda: change("height", 0, "tall"),
        "gaps.csv, column 'height', row 1: 'tall' is not allowed: expected a number.",
    ),
    "none of the columns": (
        ["run", "other.csv"],
        lambda: Path("other.csv").write_text("Age,Sex\n1,m\n"),
        "other.csv has none of the columns of the model, which are 'sex', 'colour', 'age', 'height'; "
        "it has 'Age', 'Sex'.",
    ),
    "no rows": (["run", "other.csv"], lambda: Path("other.csv").write_text("age,sex\n"), "other.csv has no rows."),
    "an output of no kind": (
        ["run", "gaps.csv", "output=out.txt"],
        None,
        "output=out.txt: expected a file that ends",
    ),
    "an output that is there": (
        ["run", "gaps.csv", "output=gaps.csv"],
        None,
        "output=gaps.csv: the file is there already. Choose another, or type overwrite=true.",
    ),
    "no such setting": (["run", "gaps.csv", "outputs=a.csv"], None, "outputs"),
}
OF_IMPUTE: dict[str, tuple[list[str], Callable[[], object] | None, str]] = {
    "no draws": (["run", "gaps.csv", "m=0"], None, "m = 0 is not allowed: expected an integer >= 1."),
    "too many draws": (["run", "gaps.csv", "m=1001"], None, "m = 1001 is not allowed: expected at most 1,000"),
    "sequences of a table": (
        ["run", "gaps.csv", "output=a.fasta"],
        None,
        "output=a.fasta: these rows are no sequences. Choose .csv, .parquet or .npz.",
    ),
    "probabilities that are there": (
        ["run", "gaps.csv", "output=a.csv", "probabilities=gaps.csv"],
        None,
        "probabilities=gaps.csv: the file is there already. Choose another, or type overwrite=true.",
    ),
    "both in one file": (
        ["run", "gaps.csv", "output=a.csv", "probabilities=a.csv"],
        None,
        "probabilities=a.csv: the completed table goes there. Choose another file.",
    ),
    "a draw that is there": (
        ["run", "gaps.csv", "output=a.csv", "m=3"],
        lambda: Path("a-2.csv").write_text(""),
        "output=a-2.csv: the file is there already. Choose another, or type overwrite=true.",
    ),
    "one chain": (["run", "gaps.csv", "chains=1"], None, "n_chains = 1 is not allowed: expected an integer >= 2."),
}


@pytest.mark.parametrize(
    ("command", "arguments", "spoil", "message"),
    [
        *(
            pytest.param(name, *case, id=f"{name}, {what}")
            for what, case in WRONG.items()
            for name in ("impute", "score")
        ),
        *(pytest.param("impute", *case, id=f"impute, {what}") for what, case in OF_IMPUTE.items()),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    run_command: Any,
    run: str,
    command: str,
    arguments: list[str],
    spoil: Callable[[], object] | None,
    message: str,
) -> None:
    if spoil is not None:
        spoil()
    before = {path: path.read_bytes() for path in Path().glob("*.*") if path.is_file()}
    outcome = run_command(f"memcomp-{command}", {"impute": impute, "score": score}[command].main, tuple(arguments))
    assert outcome.status == 2
    assert outcome.out == ""
    assert message in outcome.err
    assert outcome.err.startswith(f"memcomp-{command}: ")
    assert outcome.err.count("\n") == 1
    assert {path: path.read_bytes() for path in Path().glob("*.*") if path.is_file()} == before


@pytest.mark.parametrize("command", ["impute", "score"])
def test_help_shows_the_settings(run_command: Any, command: str) -> None:
    outcome = run_command(f"memcomp-{command}", {"impute": impute, "score": score}[command].main, ("--help",))
    assert outcome.status == 0
    assert f"memcomp-{command} RUN TABLE [setting=value ...]" in outcome.out
    assert "  seed=0\n" in outcome.out
    assert "  overwrite=false\n" in outcome.out


def test_what_was_there_is_replaced_on_request(memcomp_score: Command, run: str) -> None:
    Path("scores.csv").write_text("old")
    assert memcomp_score(run, "people.csv", "overwrite=true", "pseudo=false").status == 0
    assert "pseudo_log_likelihood" not in pd.read_csv("scores.csv").columns


def test_the_schema_is_not_that_of_the_run(memcomp_impute: Command, run: str) -> None:
    """A hand that changed schema.json: the weights do not fit it."""
    path = Path("run/schema.json")
    schema = json.loads(path.read_text())
    schema["columns"] = schema["columns"][:-1]
    path.write_text(json.dumps(schema))
    outcome = memcomp_impute(run, "gaps.csv")
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1


def test_files_of_a_table_are_scored_one_after_the_other(memcomp_score: Command, run: str) -> None:
    """The rows of all of them, as if they were one; log Z is found once."""
    Path("parts").mkdir()
    table = gappy()
    for name, some in (("a", people()[:3]), ("b", table[3:200]), ("c", table[200:])):
        some.to_csv(f"parts/{name}.csv", index=False)
    pd.concat([people()[:3], table[3:]]).to_csv("all.csv", index=False)
    whole = memcomp_score(run, "all.csv", "output=whole.csv")
    assert whole.status == 0, whole.err
    for path in ("parts", "parts/*.csv"):
        outcome = memcomp_score(run, path, "output=parts.csv", "overwrite=true")
        assert outcome.status == 0, outcome.err
        found, expected = read("parts.csv"), read("whole.csv")
        assert list(found.columns) == list(expected.columns)
        for name in ("row", "id", "class"):
            if name in expected:
                assert (found[name] == expected[name])[: 3 if name == "class" else None].all()
        for name in ("log_likelihood", "free_energy"):
            one, other = (frame[name].replace("", "nan").astype(float) for frame in (found, expected))
            assert (one.isna() == other.isna()).all()
            assert ((one - other).abs() < 1e-3).mean() > 0.9, "what is drawn for gaps is drawn for each file"
        line = next(text for text in whole.out.splitlines() if "300 rows" in text)
        assert line.split(" ±")[0][:-2] in outcome.out
    refused = memcomp_score(run, "parts", "figures=looks.png")
    assert (refused.status, "parts is several files. Leave it out." in refused.err) == (2, True)
    (Path("parts") / "d.csv").write_text("")
    assert "d.csv is empty" in memcomp_score(run, "parts", "overwrite=true").err
