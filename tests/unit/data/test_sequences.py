"""Alignments from files: every way in which one is written, and what is wrong with those that are refused."""

import bz2
import gzip
import json
import sys

import numpy as np
import pytest
import torch

from memcomp_lightning.data import Sequences, SequenceSchema, TableDataModule
from memcomp_lightning.data.schema import schema_of
from memcomp_lightning.data.sequences.alignment import aligned
from memcomp_lightning.data.sequences.files import read_sequences
from memcomp_lightning.data.written import write_columns
from memcomp_lightning.errors import SettingError, UserError

pytest.importorskip("Bio")
pytest.importorskip("pyarrow")

PROTEINS = ["ACDEFGHIKL", "MNPQRSTVWY", "AC-EFGHIKX", "----------"]
RNAS = ["GAUUACA-NN", "GCUUACA-AA", "CGCGAUAUGC"]


@pytest.fixture
def written(tmp_path):
    """Writes a file, and returns its path."""

    def write(text, name="family.fasta"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def fasta(sequences, width=80, mark=">", newline="\n"):
    lines = []
    for number, sequence in enumerate(sequences, start=1):
        lines += [f"{mark}s{number} a family", *(sequence[k : k + width] for k in range(0, len(sequence), width))]
    return newline.join([*lines, ""])


def load(path, **settings):
    return Sequences(path=str(path), test=str(path), **settings).load()


def refused(path, **settings):
    with pytest.raises(UserError) as error:
        load(path, **settings)
    assert "\n" not in str(error.value)
    return str(error.value)


WAYS = {
    "wrapped": (fasta(PROTEINS, width=3), "a.fasta"),
    "two marks": (fasta(PROTEINS, mark=">>"), "a.fa"),
    "other line ends": (fasta(PROTEINS, width=7, newline="\r\n"), "a.fasta"),
    "blanks": ("\n\n" + fasta(PROTEINS).replace("CDE", "C D E "), "a.fasta"),
    "byte order mark": ("\ufeff" + fasta(PROTEINS), "a.fasta"),
    "gzip": (gzip.compress(fasta(PROTEINS).encode()), "a.fasta.gz"),
    "bzip2": (bz2.compress(fasta(PROTEINS).encode()), "a.faa.bz2"),
    "table": ("name,sequence\n" + "".join(f"s,{one}\n" for one in PROTEINS), "a.csv"),
    "packed table": (gzip.compress(("sequence\tyear\n" + "\t1\n".join([*PROTEINS, ""])).encode()), "a.tsv.gz"),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_read_is_written_again(written, way):
    path = written(*WAYS[way])
    data = load(path)
    assert (data.schema.alphabet, data.n_sites, data.units().n) == ("protein", 10, 210)
    decoded = data.schema.decode(data.train.v.masked_fill(~data.train.observed, torch.nan))
    assert list(decoded) == ["sequence"]
    assert decoded["sequence"].tolist() == PROTEINS
    again = data.schema.read(path)
    assert again.v.equal(data.train.v)
    assert again.observed.equal(data.train.observed)


@pytest.mark.parametrize("ending", [".fasta", ".csv", ".parquet"])
def test_files_of_ours_are_read(tmp_path, written, ending):
    data = load(written(fasta(RNAS)))
    path = tmp_path / f"out{ending}"
    write_columns(data.schema.decode(data.train.v), path)
    assert data.schema.read(path).v.equal(data.train.v)


def test_numbers_are_those_of_the_letters(written):
    data = load(written(fasta(["ACGU-", "UUUUU"])), similarity=None)
    assert data.train.v.tolist() == [[0, 1, 2, 3, 4], [3] * 5]
    assert data.train.observed is None
    assert data.train.label.tolist() == [-1, -1]
    assert data.schema.entry_names[3:6] == ["1=U", "1=-", "2=A"]
    assert data.schema.site_names == ["1", "2", "3", "4", "5"]
    entries = TableDataModule(data).train[0]
    assert entries[0].nonzero().flatten().tolist() == [
        data.schema.entry_names.index(f"{k + 1}={x}") for k, x in enumerate("ACGU-")
    ]


def test_letters_that_are_not_known_are_missing(written):
    protein = load(written(fasta(["AXN?M", "WYNKM"])))
    assert protein.train.observed.tolist() == [[True, False, True, False, True], [True] * 5]
    assert protein.train.v[0, [1, 3]].tolist() == [0, 0]
    rna = load(written(fasta(["ACN?U", "ACGGU"])))
    assert rna.train.observed.tolist() == [[True, True, False, False, True], [True] * 5]
    assert "40.00% " not in rna.described()
    assert "20.00% of the letters" in rna.described()
    assert "'X' is no letter of dna" in refused(written(fasta(["ACXGT", "ACGGT"])))


def test_completed_sequences_keep_their_names(written):
    path = written(fasta(["AXN?M", "WYNKM"]))
    schema = load(path).schema
    v = schema.read(path, complete=False).v
    v[0, [1, 3]] = torch.tensor([9.0, 20.0])
    found = schema.filled(path, v)
    assert list(found) == ["name", "sequence"]
    assert found["name"].tolist() == ["s1", "s2"]
    assert found["sequence"].tolist() == ["ALN-M", "WYNKM"]
    table = written("id,sequence,note\n7,AXN?M,first\n8,WYNKM,\n", "family.csv")
    found = schema.filled(table, v)
    assert {name: column.tolist() for name, column in found.items()} == {
        "id": ["7", "8"],
        "sequence": ["ALN-M", "WYNKM"],
        "note": ["first", ""],
    }


def test_a_row_without_a_known_letter_is_refused_but_where_gaps_are_filled(written):
    schema = SequenceSchema(3, "dna")
    path = written(fasta(["ACG", "NN?"]))
    with pytest.raises(UserError, match=r"sequence 's2', line 3: every letter is missing"):
        schema.read(path)
    assert schema.read(path, complete=False).observed[1].tolist() == [False] * 3


@pytest.mark.parametrize(
    ("sequences", "alphabet"),
    [
        (["ACGT", "TTGA"], "dna"),
        (["ACGU", "UUGA"], "rna"),
        (["acgu", "uuga"], "rna"),
        (["NNNA", "AC-C"], "dna"),
        (["ACUT", "UUAA"], "rna"),
        (["ACUT", "TTAA"], "dna"),
        (["ACGTWW", "ACGTLK"], "protein"),
    ],
)
def test_alphabets_are_found(written, sequences, alphabet):
    assert load(written(fasta(sequences))).schema.alphabet == alphabet


def test_t_and_u_are_one_letter_and_the_other_one_is_shown(written):
    path = written(fasta(["ACTU-", "UUUUU"]))
    data = load(path)
    assert data.train.v[0].tolist() == [0, 1, 3, 3, 4]
    assert "1 T as U" in data.described()
    dna = load(path, alphabet="dna")
    assert dna.schema.decode(dna.train.v)["sequence"].tolist() == ["ACTT-", "TTTTT"]
    assert "6 U as T" in dna.described()
    assert "'U' is no letter of protein" in refused(path, alphabet="protein")


def test_lower_case_and_points_of_one_length_are_letters_and_gaps(written):
    path = written(fasta(["AcD.E", "ACDKe"]))
    data = load(path)
    assert data.schema.decode(data.train.v)["sequence"].tolist() == ["ACD-E", "ACDKE"]
    assert "2 lower case letters as upper case" in data.described()
    assert "1 points as gaps" in data.described()
    assert "ignored" not in data.described()


def test_lower_case_and_points_are_insertions_where_only_then_the_lengths_fit(written):
    path = written(fasta(["ACaaD", "AC.D", "ACD"]))
    data = load(path)
    assert data.schema.decode(data.train.v)["sequence"].tolist() == ["ACD"] * 3
    assert "insertions  ignored, 3 lower case letters and points" in data.described()
    assert data.schema.read(written(fasta(["aAClD"]), "new.a3m")).v.equal(data.train.v[:1])
    assert "4 sites, where others have 5" in refused(path, insertions="keep")


def test_insertions_can_be_asked_for(written):
    path = written(fasta(["ACaD", "AC.D"]))
    assert load(path).n_sites == 4
    data = load(path, insertions="remove")
    assert data.schema.decode(data.train.v)["sequence"].tolist() == ["ACD", "ACD"]
    assert data.schema.read(path).v.shape == (2, 3)
    assert schema_of(data.schema.as_json()).read(path).v.shape == (2, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (fasta(["ACDEF", "AC*EF"], width=2), "sequence 's2', line 7: '*' is no letter of protein"),
        (fasta(["ACDEFW", "ACBEFW"], width=2), "sequence 's2', line 7: 'B' is no letter"),
        (fasta(["ACDEFW", "ACDEFÖ"]), "sequence 's2', line 4: 'Ö' is no letter"),
        (fasta(["ACaaaD", "ACbbJ"], width=3), "sequence 's2', line 6: 'J' is no letter"),
        (fasta(["ACGTA", "ACGTA", "AC1TA"]), "sequence 's3', line 6: '1' is no letter of dna"),
        (fasta(["ACDEF", "ACDE", "ACDEF"], width=2), "sequence 's2', line 5: 4 sites, where others have 5"),
        (fasta(["ACD", "ACDE", "ACDE"]), "sequence 's1', line 1: 3 sites, where others have 4"),
        (fasta(["ACaD", "ACD", "AC.DE"]), "sequence 's3', line 5: 4 sites without lower case letters and points"),
        (fasta(["acd", "acde", "acde"]), "sequence 's1', line 1: 3 sites, where others have 4"),
        ("", "family.fasta has no sequence"),
        ("\n\n", "family.fasta has no sequence"),
        ("ACDEF\n", "line 1: 'ACDEF' is no FASTA"),
        ("# STOCKHOLM 1.0\n>s1\nACDEF\n", "line 1: '# STOCKHOLM 1.0' is no FASTA"),
        (">s1\n>s2\nACD\n", "sequence 's1', line 1: there is no sequence."),
        (">s1\nACD\n>s2", "sequence 's2', line 3: there is no sequence. The file ends in the middle."),
        (">s1\nACD\n>\n", "sequence '2', line 3: there is no sequence"),
        (fasta(["ACD", "XX?"]), "sequence 's2', line 3: every letter is missing"),
    ],
)
def test_what_does_not_fit_is_named_with_its_line(written, text, message):
    found = refused(written(text))
    assert message in found
    assert "family.fasta" in found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,seq\na,ACD\n", "has no column 'sequence'; it has 'name', 'seq'"),
        ("name,sequence\na,ACD\nb,\n", "row 2: there is no sequence."),
        ("name,sequence\na,ACD\nb,ACJ\n", "row 2: 'J' is no letter"),
        ("name,sequence\na,ACD\nb,ACDE\nc,ACD\n", "row 2: 4 sites, where others have 3"),
        ("name,sequence\n", "has no sequence"),
    ],
)
def test_what_does_not_fit_in_a_table_is_named_with_its_row(written, text, message):
    found = refused(written(text, "family.csv"))
    assert message in found
    assert "ends in the middle" not in found


def test_a_file_that_ends_in_the_middle_of_a_packed_block(written):
    packed = gzip.compress(fasta(PROTEINS * 50).encode())
    assert "is damaged, or ends in the middle" in refused(written(packed[:-20], "a.fasta.gz"))
    assert "is damaged, or ends in the middle" in refused(written(b"no gzip", "a.fasta.gz"))
    assert "there is no such file" in refused("nowhere.fasta")


@pytest.mark.parametrize(("name", "package"), [("a.fasta", "Bio"), ("a.csv", "memcomp_lightning.data.tables")])
def test_what_is_not_installed_is_named(written, monkeypatch, name, package):
    path = written(fasta(PROTEINS), name)
    for module in [module for module in sys.modules if module.startswith(package)]:
        monkeypatch.setitem(sys.modules, module, None)
    assert "is not installed: pip install 'memcomp-lightning[tables]'" in refused(path)


def test_a_schema_holds_files_to_its_length_and_letters(written):
    schema = load(written(fasta(RNAS))).schema
    with pytest.raises(UserError, match=r"'s1', line 1: 4 sites, where the model has 10"):
        schema.read(written(fasta(["ACGU"])))
    with pytest.raises(UserError, match=r"'s1', line 2: 'W' is no letter of rna"):
        schema.read(written(fasta(["ACGUWACGUA"])))


@pytest.mark.parametrize("insertions", [None, "keep", "remove"])
def test_a_schema_is_kept_as_json(insertions):
    schema = SequenceSchema(7, "rna", insertions)
    kept = json.loads(json.dumps(schema.as_json()))
    assert schema_of(kept) == schema
    with pytest.raises(UserError, match="another version"):
        schema_of({**kept, "letters": "-ACGU"})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"similarity": 0}, "data.similarity = 0"),
        ({"similarity": 1.01}, "data.similarity = 1.01"),
        ({"similarity": True}, "data.similarity = True"),
        ({"alphabet": "greek"}, "'protein', 'rna', 'dna'"),
        ({"insertions": "drop"}, "'keep', 'remove'"),
        ({"test_fraction": 1.0}, "data.test_fraction"),
        ({"split_seed": -1}, "data.split_seed"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(SettingError) as error:
        Sequences(path="a.fasta", **settings)
    assert message in str(error.value)


def test_a_path_is_asked_for():
    with pytest.raises(UserError, match=r"data\.path=FILE"):
        Sequences()


def many(n=60):
    """Twenty different sequences, each of which stands three times in another place."""
    draws = np.random.default_rng(0).integers(20, size=(20, 6))
    return ["".join("ACDEFGHIKLMNPQRSTVWY"[x] for x in draws[k % 20]) for k in range(n)]


def test_copies_are_split_off_together(written):
    path = written(fasta(many()))
    data = Sequences(path=str(path), test_fraction=0.25).load()
    assert (data.train.n, data.test.n) == (45, 15)
    train, test = (set(data.schema.decode(rows.v)["sequence"]) for rows in (data.train, data.test))
    assert not train & test
    assert len(train | test) == 20
    again = Sequences(path=str(path), test_fraction=0.25).load()
    assert again.test.v.equal(data.test.v)
    assert not Sequences(path=str(path), test_fraction=0.25, split_seed=1).load().test.v.equal(data.test.v)


def test_a_share_that_leaves_nothing_is_refused(written):
    path = written(fasta(["ACD"] * 9 + ["WYV"]))
    assert Sequences(path=str(path), test_fraction=0.1).load().test.n == 1
    for text, share in ((fasta(["ACD"] * 9), 0.5), (fasta(many()), 0.04)):
        with pytest.raises(SettingError, match=r"data\.test_fraction"):
            Sequences(path=str(written(text)), test_fraction=share).load()


def test_sequences_to_look_at_and_to_test_on_come_from_files(written):
    train, other = written(fasta(PROTEINS)), written(fasta(PROTEINS[:2]), "other.fasta")
    data = Sequences(path=str(train), test=str(other), validation=str(other)).load()
    assert (data.train.n, data.test.n, data.validation.n) == (4, 2, 2)
    module = TableDataModule(data)
    assert module.validation[0].shape == (2, 210)
    with pytest.raises(UserError, match=r"other\.fasta, sequence 's1'"):
        Sequences(path=str(written(fasta(RNAS))), test=str(other)).load()


def test_training_sequences_alone_have_weights(written):
    path = written(fasta(["ACDEF", "ACDEF", "ACDEY", "WWWWW"]))
    data = load(path)
    assert data.train.weight.tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3, 1])
    assert data.test.weight is None
    assert data.effective_number == pytest.approx(2)
    assert "80 % identical sites or more; effective number 2.0" in data.described()
    (batch,) = TableDataModule(data, batch_size=None).train_batches(0, 1)
    assert batch.weight.equal(data.train.weight)
    unweighted = load(path, similarity=None)
    assert unweighted.train.weight is None
    assert unweighted.effective_number == 4
    assert "weights     none" in unweighted.described()


def test_weighted_sequences_are_not_dealt_into_parts(written):
    path = written(fasta(many()))
    with pytest.raises(SettingError, match=r"data\.similarity=null"):
        TableDataModule(load(path), partitions=2)
    assert TableDataModule(load(path, similarity=None), partitions=2).replicas == (2,)


def test_some_of_the_rows_have_their_own_weights(written, monkeypatch):
    data = load(written(fasta(["ACDE", "WWWW", "ACDE", "YYYY", "ACDE", "VVVV"])))
    monkeypatch.setattr(TableDataModule, "most_numbers", 3 * 84)
    some = TableDataModule(data).some_train()
    assert some.v.shape == (3, 84)
    assert some.weight.tolist() == pytest.approx([1 / 3] * 3)


def test_places_are_those_in_the_file(written):
    file = read_sequences(written(fasta(["ACaD", "ACD"], width=2)))
    assert file.place(0).endswith("sequence 's1', line 1")
    assert file.place(0, 2).endswith("line 3")
    assert file.place(1, 0).endswith("line 5")
    assert aligned(file).n_removed == 1
