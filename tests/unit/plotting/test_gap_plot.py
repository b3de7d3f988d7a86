"""The picture of gaps against time: a mark for each answer, and the mean on the way."""

import numpy as np
import pytest

from memcomp_lightning.errors import SettingError
from memcomp_lightning.plotting import plot_gaps


def drawn(axes, label):
    """Marks of a solver, and the line in its colour."""
    (marks,) = (line for line in axes.get_lines() if line.get_label() == label)
    others = [line for line in axes.get_lines() if line is not marks and line.get_color() == marks.get_color()]
    return np.column_stack(marks.get_data()), [np.column_stack(line.get_data()) for line in others]


def test_marks_at_the_ends_and_a_line_of_the_mean():
    curves = {
        "best": [[(1.0, 0.5), (3.0, 0.1), (4.0, 0.1)], [(2.0, 0.3), (4.0, 0.0), (5.0, 0.0)]],
        "tabu": [[(2.0, 0.2)], [(0.0, -0.1)]],
    }
    (axes,) = plot_gaps(curves, title="two").axes
    marks, (line,) = drawn(axes, "best")
    np.testing.assert_allclose(marks, [[4, 10], [5, 0]])
    np.testing.assert_allclose(line, [[2, 40], [3, 20], [4, 5], [5, 5]], err_msg="once both have begun")
    marks, lines = drawn(axes, "tabu")
    np.testing.assert_allclose(marks, [[2, 20], [1e-4, -10]])
    assert lines == []
    assert axes.get_title(loc="left") == "two"


@pytest.mark.parametrize(
    ("gap", "kind"), [(0.0, "png"), (1e-9, "png"), (3.0, "png"), (-0.5, "png"), (3.0, "svg"), (3.0, "pdf")]
)
def test_any_gap_is_drawn(tmp_path, kind, gap):
    plot_gaps({"best": [[(0.1, gap)]], "none": []}).savefig(tmp_path / f"gap.{kind}")
    assert (tmp_path / f"gap.{kind}").stat().st_size > 1000


def test_nothing_is_refused():
    with pytest.raises(SettingError, match="expected one answer or more"):
        plot_gaps({"best": []})
