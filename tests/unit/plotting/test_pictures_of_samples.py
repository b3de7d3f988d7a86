"""Pictures of samples against data: what is drawn is what the numbers say."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PathCollection

from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.plotting import (
    DiscreteCells,
    Points,
    RealCells,
    plot_correlations,
    plot_imputation,
    plot_likelihoods,
    plot_marginals,
    plot_plane,
)
from memcomp_lightning.plotting.correlations import agreement, covariances
from memcomp_lightning.plotting.imputation import calibration
from memcomp_lightning.plotting.plane import principal_plane
from memcomp_lightning.plotting.written import write_figures
from memcomp_lightning.rng import numpy_stream

RANDOM = numpy_stream(0, "pictures of samples")
X = RANDOM.standard_normal((400, 5)) @ RANDOM.standard_normal((5, 5))
GAPS = np.where(RANDOM.random(X.shape) < 0.2, np.nan, X)
WEIGHT = RANDOM.random(400) + 0.1


def words(*texts: str | None) -> np.ndarray:
    return np.array(texts, dtype=object)


def titles(figure):
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def bars(axes):
    """Heights of the bars of data and of samples."""
    return [[bar.get_height() for bar in group] for group in axes.containers]


def test_marginals_are_shares_and_those_furthest_apart_come_first() -> None:
    data = {
        "same": words("a", "b", "a", "b"),
        "apart": words("f", "m", None, "m"),
        "real": np.array([0.0, 1, 2, np.nan]),
        "empty": words(None, None, None, None),
        "not drawn": np.zeros(4),
    }
    samples = {
        "same": words("a", "b"),
        "apart": words("f", "f"),
        "real": np.array([1.0, 1, 1]),
        "empty": words("a"),
    }
    figure = plot_marginals(data, samples)
    assert titles(figure) == ["apart (0.67 apart)", "real (0.67 apart)", "same (0.00 apart)"]
    np.testing.assert_allclose(bars(figure.axes[0]), [[1 / 3, 2 / 3], [1, 0]])
    assert [label.get_text() for label in figure.axes[1].get_xticklabels()] == ["0", "1", "2"]
    weighted = plot_marginals(data, samples, weight=np.array([3.0, 1, 5, 1]), n_panels=2)
    assert titles(weighted) == ["real (0.89 apart)", "apart (0.40 apart)"]
    np.testing.assert_allclose(bars(weighted.axes[1])[0], [0.6, 0.4])
    with pytest.raises(SettingError, match="expected one or more that samples have"):
        plot_marginals({"empty": data["empty"]}, samples)


def test_numbers_are_densities_and_whole_ones_fill_their_bins_alike() -> None:
    whole = np.arange(1000) % 37
    (axes,) = plot_marginals({"x": whole}, {"x": whole[::-1]}).axes
    heights, edges, _ = axes.patches[0].get_data()
    assert edges[0] == -0.5
    assert set(np.diff(edges)) == {2.0}
    np.testing.assert_allclose(heights[:-1], 1 / 37, rtol=0.05)
    shifted = plot_marginals({"x": X[:, 0]}, {"x": X[:, 0] + 100})
    assert titles(shifted) == ["x (1.00 apart)"]


def test_covariances_are_of_the_rows_that_have_both() -> None:
    known = ~np.isnan(GAPS)
    found = covariances(Points(GAPS, WEIGHT))
    for i, j in ((0, 0), (0, 3), (4, 1)):
        both = known[:, i] & known[:, j]
        wanted = np.cov(GAPS[both, i], GAPS[both, j], aweights=WEIGHT[both], ddof=0)
        assert found[i, j] == pytest.approx(wanted[0, 1])
    np.testing.assert_allclose(
        covariances(Points(X + 1e6, WEIGHT)), np.cov(X.T, aweights=WEIGHT, ddof=0), rtol=1e-6
    )
    never = np.where([True, False], GAPS[:, :2], np.nan)
    assert np.isnan(covariances(Points(never))[0, 1])


def test_correlations_show_each_pair_of_sites_once() -> None:
    states = RANDOM.integers(0, 3, (500, 3))
    one_hot = np.eye(3)[states].reshape(500, 9)
    data = Points(np.hstack((one_hot, 50 * X[:250, :1].repeat(2, 0))))
    site = np.array([0, 0, 0, 1, 1, 1, 2, 2, 2, 3])
    half = Points(np.vstack((data.x, data.x[::-1] * 0)))  # half of the rows are zero
    figure = plot_correlations(data, data, half, site=site, names=[f"e{k}" for k in range(10)])
    assert titles(figure)[0] == "samples: r = 1.000, slope 1.00"
    marks = [next(c for c in axes.collections if isinstance(c, PathCollection)) for axes in figure.axes]
    drawn = marks[0].get_offsets()
    assert len(drawn) == 45 - 9
    assert figure.get_supxlabel().endswith("36 pairs")
    scaled = covariances(Points(data.x / np.append(np.ones(9), data.x[:, -1].std())))
    np.testing.assert_allclose(
        sorted(drawn[:, 0]),
        sorted(scaled[np.triu_indices(10, 1)][np.triu(site[:, None] != site, 1)[np.triu_indices(10, 1)]]),
    )
    of_half = covariances(Points(half.x / np.append(np.ones(9), data.x[:, -1].std())))
    fit = agreement(drawn[:, 0], marks[1].get_offsets()[:, 1])
    assert titles(figure)[1] == f"held-out data: r = {fit.r:.3f}, slope {fit.slope:.2f}"
    assert sorted(marks[1].get_offsets()[:, 1])[0] == pytest.approx(of_half[np.triu(site[:, None] != site)].min())
    with pytest.raises(SettingError, match="number of sites = 1"):
        plot_correlations(Points(one_hot[:, :3]), Points(one_hot[:, :3]), site=site[:3])


def test_the_pair_that_is_furthest_off_is_named_and_many_pairs_are_counted() -> None:
    x = np.sign(RANDOM.standard_normal((300, 90)))
    samples = x.copy()
    samples[:, 70] = samples[:, 7]
    figure = plot_correlations(Points(x), Points(samples), names=[f"spin {k}" for k in range(90)])
    assert figure.axes[0].texts[0].get_text() == "furthest off:\nspin 7\nspin 70"
    (places,) = figure.axes[0].collections
    assert places.get_array().sum() == 90 * 89 / 2
    still = Points(np.hstack((0 * x[:, :5], x[:, :4])))
    few = plot_correlations(still, still, most=4)
    assert few.get_supxlabel().endswith(" 6 pairs")
    assert np.abs(few.axes[0].collections[0].get_offsets()).min() > 0


def test_the_plane_is_that_of_the_data() -> None:
    plane = principal_plane(Points(X))
    _, size, directions = np.linalg.svd(X - X.mean(0))
    np.testing.assert_allclose(np.abs(plane.directions @ directions[:2].T), np.eye(2), atol=1e-8)
    np.testing.assert_allclose(plane.shares, (size**2 / (size**2).sum())[:2])
    weighted = principal_plane(Points(X, WEIGHT))
    np.testing.assert_allclose(weighted.mean, WEIGHT @ X / WEIGHT.sum())
    variances = np.linalg.eigvalsh(np.cov(X.T, aweights=WEIGHT))[::-1]
    np.testing.assert_allclose(weighted.shares, variances[:2] / variances.sum())
    with pytest.raises(SettingError, match="number of entries = 1"):
        plot_plane(Points(X[:, :1]), Points(X[:, :1]))


def test_samples_lose_what_the_data_lack() -> None:
    """The same rows with the same gaps are the same picture, and a panel is a distribution."""
    alike = plot_plane(Points(GAPS), Points(X), Points(X[:100]))
    data, samples, heldout = (axes.collections[0].get_array().filled(0) for axes in alike.axes)
    np.testing.assert_allclose(data, samples)
    assert np.abs(data - heldout).max() > 0.1 * data.max()
    assert data.sum() == pytest.approx(1, abs=0.02)
    lines = alike.axes[0].collections[1]
    assert [round(float(data[data >= level].sum()), 1) for level in lines.levels] == [0.9, 0.5]


def test_likelihoods_share_an_axis_and_rows_count_by_weight() -> None:
    values = {"data": np.array([0.0, 1.0, np.nan]), "samples": np.linspace(0, 1, 50)}
    figure = plot_likelihoods(values, weights={"data": np.array([3.0, 1.0, 9.0])}, n_bins=4)
    (axes,) = figure.axes
    shares = {patch.get_label(): patch.get_data().values for patch in axes.patches[1::2]}
    np.testing.assert_allclose(shares["data, mean 0.25"], [0.75, 0, 0, 0.25])
    assert "samples, mean 0.5" in shares
    assert [line.get_xdata()[0] for line in axes.lines] == pytest.approx([0.25, 0.5])
    with pytest.raises(SettingError, match="1 to 4 sets with a finite number"):
        plot_likelihoods({"data": np.array([np.nan])})


def test_imputation_shows_coverage_and_calibration() -> None:
    truth, mean = np.array([1.0, 2, 3, 4]), np.array([1.0, 2, 0, 9])
    cells = RealCells(truth, mean, mean - 1, mean + 1)
    p = np.array([0.05, 0.08, 0.55, 0.95, 1.0])
    discrete = DiscreteCells(p, np.array([0.0, 0, 1, 1, 1]))
    figure = plot_imputation({"age": cells, "empty": RealCells(*[np.zeros(0)] * 4)}, discrete)
    np.testing.assert_allclose(calibration(discrete), [[0.065, 0.55, 0.975], [0, 1, 1], [2, 1, 2]])
    off = (2 * 0.065 + 0.45 + 2 * 0.025) / 5
    assert titles(figure) == ["age: 50% within", f"states: {off:.3f} off"]
    with pytest.raises(SettingError, match="masked cells = 0"):
        plot_imputation({}, DiscreteCells(np.zeros(0), np.zeros(0)))


def test_figures_are_written_whole_and_replaced_on_request_alone(tmp_path: Path) -> None:
    figures = {
        "marginals": plot_marginals(
            {"a long name of a column": words("a word", "another one")},
            {"x": X[:, 0]} | {"a long name of a column": words("a word")},
        ),
        "free_energies": plot_likelihoods({"data": X[:, 0]}),
    }
    write_figures(figures, tmp_path / "folder")
    assert sorted(path.name for path in (tmp_path / "folder").iterdir()) == ["free_energies.png", "marginals.png"]
    write_figures(figures, tmp_path / "all.pdf")
    assert (tmp_path / "all.pdf").read_bytes().count(b"/Type /Page ") == 2
    write_figures(figures, tmp_path / "all.png")
    sizes = [png_size(path) for path in (*(tmp_path / "folder").iterdir(), tmp_path / "all.png")]
    assert sizes[2] == (max(sizes[0][0], sizes[1][0]), sizes[0][1] + sizes[1][1])
    for place, why in (
        ("folder", "there are figures already"),
        ("all.pdf", "the file is there already"),
        ("figure.svg", "expected a folder, or a file that ends in .png or .pdf"),
        ("nowhere/folder", "there is no folder"),
    ):
        with pytest.raises(UserError, match=why):
            write_figures(figures, tmp_path / place)
    write_figures({"marginals": figures["marginals"]}, tmp_path / "folder", overwrite=True)


def png_size(path: Path) -> tuple[int, int]:
    header = path.read_bytes()[16:24]
    return int.from_bytes(header[:4]), int.from_bytes(header[4:])
