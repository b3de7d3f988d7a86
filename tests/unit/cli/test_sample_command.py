"""``memcomp-sample``: what it writes and says, and what it refuses before it draws."""

import csv

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.cli import products
from memcomp_lightning.cli.commands import sample as command
from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.schema import ImageSchema
from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Real, SpinColumn
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.models.units import Bernoulli, Spin
from memcomp_lightning.trained import Run
from memcomp_lightning.trained.given import given_row

TABLE = TableSchema(
    (
        Real("age", 35.0, 9.0, whole=True),
        Binary("smokes", ("no", "yes")),
        Category("colour", ("blue", "green", "red")),
        SpinColumn("up"),
        Real("height", 170.0, 8.0),
        Category("children", (0, 1, 2)),
    ),
    Category("species", ("cat", "dog")),
)
PICTURES = ImageSchema(PixelLayout(2, 3), 0)


@pytest.fixture
def use(tmp_path, monkeypatch):
    """Let the command find a run of this schema and model, and work in an empty folder."""

    def use(schema, model):
        monkeypatch.setattr(products, "load", lambda path, **_: Run(tmp_path, model, None, schema, {}))
        monkeypatch.chdir(tmp_path)
        return tmp_path

    return use


@pytest.fixture
def table(use):
    generator = rng.stream(0, "test model")
    rbm = RBM(visible=TABLE.units(), hidden=Bernoulli(5), weight_init=Normal(std=0.5), generator=generator)
    return use(TABLE, rbm)


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        command.main(["run", *arguments])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_rows_are_in_the_users_columns_and_words(table, capsys):
    command.main(["run"])
    found = rows(table / "rows.csv")
    assert len(found) == 1000
    assert list(found[0]) == ["age", "smokes", "colour", "up", "height", "children"]
    values = {name: {row[name] for row in found} for name in found[0]}
    assert values["smokes"] == {"no", "yes"}
    assert values["colour"] == {"blue", "green", "red"}
    assert values["up"] == {"-1", "1"}
    assert values["children"] == {"0", "1", "2"}
    assert all(float(age).is_integer() for age in values["age"])
    assert len(values["height"]) > 900  # draws, no means
    said = capsys.readouterr().out
    assert "1,000 rows in" in said
    assert "exact, independent rows: all 2^5 states" in said
    command.main(["run", "n=200", "method=gibbs", "output=rows.tsv"])
    said = capsys.readouterr().out
    assert all(word in said for word in ("autocorrelation", "R-hat", "effective", "200 rows"))


def test_given_values_hold_in_every_row(table):
    command.main(["run", "given={age: 30, smokes: yes, children: 2}", "n=50"])
    found = rows(table / "rows.csv")
    assert len(found) == 50
    assert {(row["age"], row["smokes"], row["children"]) for row in found} == {("30", "yes", "2")}
    assert {row["colour"] for row in found} == {"blue", "green", "red"}


def test_a_table_with_gaps_is_completed(table):
    (table / "gaps.csv").write_text("age,smokes,colour,up,height,children\n30,,red,1,,2\n41,no,blue,-1,180.5,0\n")
    command.main(["run", "given=gaps.csv", "output=whole.csv"])
    first, second = rows(table / "whole.csv")
    assert (first["age"], first["colour"], first["up"], first["children"]) == ("30", "red", "1", "2")
    assert first["smokes"] in ("no", "yes")
    assert float(first["height"])
    assert list(second.values()) == ["41", "no", "blue", "-1", "180.5", "0"]
    command.main(["run", "given=gaps.csv", "output=more.csv", "n=3"])
    assert [row["age"] for row in rows(table / "more.csv")] == ["30"] * 3 + ["41"] * 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["given={agee: 30}"], "'agee'"),
        (["given={species: cat}"], "'species'"),
        (["given={colour: mauve}"], "blue, green, red"),
        (["given={age: old}"], "a number"),
        (["given=nowhere.csv"], "given=nowhere.csv: there is no such file"),
        (["given={age: 1, smokes: no, colour: red, up: 1, height: 9, children: 0}"], "all columns"),
        (["output=rows.fasta"], "no sequences"),
        (["output=rows.txt"], ".parquet"),
        (["output=there.csv"], "overwrite=true"),
        (["figure=rows.png"], "no pictures"),
        (["temperature=0"], "temperature = 0"),
        (["method=quick"], "method = 'quick'"),
        (["n=0"], "n = 0"),
        (["m=3"], "'m'"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line_and_nothing_is_written(table, capsys, arguments, message):
    (table / "there.csv").write_text("mine")
    assert message in refused(capsys, *arguments)
    assert [path.name for path in table.iterdir()] == ["there.csv"]
    assert (table / "there.csv").read_text() == "mine"


def test_a_value_far_from_the_training_data_is_warned_of(table, capsys):
    command.main(["run", "n=3", "given={age: 300}"])
    assert "given, column 'age': a value is 29 standard deviations from the mean" in capsys.readouterr().err
    command.main(["run", "n=3", "given={age: 50}", "overwrite=true"])
    assert capsys.readouterr().err == ""


def test_more_rows_than_memory_are_refused(table, capsys):
    assert "not enough memory" in refused(capsys, "n=100000000000000")
    assert not (table / "rows.csv").exists()


def test_nothing_given_and_no_mapping(table, capsys):
    assert "given = {} has no column" in refused(capsys, "given={}")
    assert "given = 30 is not allowed: expected '{NAME: VALUE}', or text, or null" in refused(capsys, "given=30")
    assert "\"output='[a'\"" in refused(capsys, "output=[a")
    assert "'n' is no setting" in refused(capsys, "n")


def test_chains_that_do_not_mix_are_warned_of(use, capsys):
    rbm = RBM(8, 6)
    with torch.no_grad():
        rbm.weight.fill_(6.0)
        rbm.b.fill_(-18.0)
        rbm.c.fill_(-24.0)
    use(ImageSchema(PixelLayout(2, 4), 0), rbm)
    command.main(["run", "n=9", "method=gibbs", "output=a.csv"])
    said = capsys.readouterr()
    assert said.err.startswith("memcomp-sample: warning: the chains do not mix")
    assert said.err.count("\n") == 1
    command.main(["run", "n=9", "output=b.csv"])
    assert not capsys.readouterr().err


def test_pictures_are_an_array_that_can_be_given_again(use):
    model = RBM(visible=Spin(6), n_hidden=3, weight_init=Normal(std=0.5))
    folder = use(PICTURES, model)
    command.main(["run", "n=40", "output=some.npz", "figure=some.png"])
    pictures = np.load(folder / "some.npz")["x"]
    assert pictures.shape == (40, 2, 3)
    assert set(np.unique(pictures)) == {0, 1}  # grey values, no spins
    assert (folder / "some.png").read_bytes().startswith(b"\x89PNG")
    pictures[:, 0] = np.nan
    np.save(folder / "half.npy", pictures)
    command.main(["run", "given=half.npy", "output=whole.npz", "n=2"])
    whole = np.load(folder / "whole.npz")["x"]
    assert whole.shape == (80, 2, 3)
    assert set(np.unique(whole)) == {0, 1}
    np.testing.assert_array_equal(whole[:, 1], pictures[:, 1].repeat(2, axis=0))


def test_of_several_files_all_are_written_or_none(use, capsys, monkeypatch):
    folder = use(PICTURES, RBM(6, 3))
    (folder / "some.npz").write_text("mine")
    both = ["output=some.npz", "figure=some.png", "n=9"]
    refused(capsys, *both)
    assert "figures go there" in refused(capsys, *both[1:], "figures=some.png")
    with monkeypatch.context() as patch:

        def full(path, *_, **__):
            path.write_text("half")
            raise OSError("no space left")

        patch.setattr("matplotlib.image.imsave", full)
        assert "no space left" in refused(capsys, *both, "overwrite=true")
    assert [path.name for path in folder.iterdir()] == ["some.npz"]
    assert (folder / "some.npz").read_text() == "mine"
    command.main(["run", *both, "overwrite=true"])
    assert sorted(path.name for path in folder.iterdir()) == ["some.npz", "some.png"]


def test_a_folder_that_cannot_be_written_is_refused_before_rows_are_drawn(table, capsys, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)
    monkeypatch.setattr(products, "load", None)
    assert "you may not write in its folder" in refused(capsys)


class Letters:
    """A schema whose sites have letters, as those of sequences."""

    site_names = ("1", "2")
    entry_names = ("1=A", "1=C", "2=A", "2=C")


def test_given_letters_and_pixels():
    found = given_row(Letters(), {"2": "C"})
    assert found.v.tolist() == [[0, 1]]
    assert found.observed.tolist() == [[False, True]]
    with pytest.raises(Exception, match=r"'2'.*A, C"):
        given_row(Letters(), {"2": "G"})
    found = given_row(PICTURES, {"0,1": 1, "1,2": 0.5})
    assert found.v.tolist() == [[0, 1, 0, 0, 0, 0.5]]
    with pytest.raises(Exception, match=r"'0,1'.*\[0, 1\]"):
        given_row(PICTURES, {"0,1": 3})


def test_help_shows_every_setting(capsys):
    command.main(["--help"])
    said = capsys.readouterr().out
    assert "temperature=1.0" in said
    assert "seed=0" in said
    assert "overwrite=false" in said
