"""Tables and alignments that commands are measured on."""

import sys
from pathlib import Path

import numpy as np
import pytest

from memcomp_lightning.data.tables import Table

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments" / "tables"))
import alignments
import commands
import scale


def test_the_large_table_is_read_as_it_is_meant(tmp_path):
    scale.write(tmp_path / "rows.csv", 500, n_real=4, n_category=3)
    kinds = [column.kind for column in Table(path=str(tmp_path / "rows.csv")).load().schema.columns]
    assert kinds == ["real"] * 4 + ["binary"] + ["category"] * 2


def test_a_sequence_of_another_length_or_letter_is_not_valid(tmp_path):
    path = tmp_path / "drawn.fasta"
    path.write_text(">1\nAC-\n>2\nAC\n>3\nAXU\n>4\nGG\nU\n")
    share, rows = alignments.valid(path, "-ACGU", 3)
    assert share == 0.5
    assert rows.tolist() == [[1, 2, 0], [3, 3, 4]]


def test_independent_sites_have_the_likelihood_of_counts():
    train, test = np.array([[0, 1], [0, 1], [1, 1]]), np.array([[0, 0]])
    assert alignments.alone(train, test, 2) == pytest.approx(np.log(3 / 5 * 1 / 5))


def test_r_hat_is_read_from_what_the_command_says():
    used = commands.Used(
        1.0, 1.0, 0.1, "10 rows in 1 s: a.fasta\n  method           Gibbs chains\n  R-hat            1.234\n"
    )
    assert alignments.r_hat(used) == "1.234"
    assert alignments.r_hat(used._replace(out="  method           exact, independent rows\n")) == ""


def test_a_command_is_measured(tmp_path):
    used = commands.command("sample", "--help", folder=tmp_path)
    assert "method" in used.out
    assert used.core_seconds > 0.1
    assert 0.05 < used.gibibytes < 4
