"""Tables for the screen."""

from memcomp_lightning.runs.table import aligned

ROWS = [["stage", "test accuracy", "wall time"], ["finetune", ".95", "3 s"]]


def test_a_table_that_fits_has_one_line_of_titles():
    assert aligned(ROWS, most=80) == aligned(ROWS)
    assert aligned(ROWS).splitlines()[0] == "   stage  test accuracy  wall time"


def test_titles_of_a_table_that_is_too_wide_stand_below_each_other():
    assert aligned(ROWS, most=30).splitlines() == [
        "              test  wall",
        "   stage  accuracy  time",
        "────────  ────────  ────",
        "finetune       .95   3 s",
    ]
