"""Every notebook runs from top to bottom in a kernel of Jupyter, warns of nothing, and shows figures.

With fewer updates than a reader's, for what they show is for the eye. One kernel runs them one after the other,
forgetting each: most of the time of a small notebook is that of importing torch.
"""

import re
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

pytestmark = pytest.mark.xdist_group("notebooks")  # one worker, one kernel

NOTEBOOKS = {path.stem: path for path in sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))}

SHORTER = {
    "01_train_and_inspect": {"iterations=20,": "iterations=2,", "iterations=60": "iterations=2"},
    "02_the_machine": {"DmmSolver(n_restarts=100)": "DmmSolver(n_restarts=10)"},
    "03_swap_the_negative_phase": {
        "N_SEEDS, N_UPDATES = 10, 2000": "N_SEEDS, N_UPDATES = 2, 200",
        "sampler, 100)": "sampler, 3)",
    },
    "04_figure_4_and_its_controls": {
        "figure.iterations=[1,5,50]": "figure.iterations=[1,2]",
        "figure.passes=[100,200]": "figure.passes=[1,2]",
        '"finetune.batch_size=20"': '"figure.controls_at=[2]"',
    },
    "05_your_own_sampler": {"10, 3000": "10, 200"},
    "06_a_table": {"iterations=300": "iterations=5"},
    "07_sequences": {"iterations=60": "iterations=2", "range(2000)": "range(200)"},
    "08_spins": {"iterations=40": "iterations=2", "2000, seed=1": "200, seed=1"},
}
"""What stands in a notebook, once, and what takes its place."""


def shortened(name: str) -> Any:
    text = NOTEBOOKS[name].read_text()
    for written, instead in SHORTER[name].items():
        assert text.count(written) == 1, f"{name}: {written}"
        text = text.replace(written, instead)
    return jupytext.reads(text, fmt="py:percent")


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """The cells of each notebook, with what they put out."""
    found, every = {}, []
    for name in NOTEBOOKS:
        folder = tmp_path_factory.mktemp(name)
        start = nbformat.v4.new_code_cell(f"%reset -f\n%cd -q {folder}")
        found[name] = [start, *shortened(name).cells]
        every += found[name]
    notebook = nbformat.v4.new_notebook(cells=every)
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("OMP_NUM_THREADS", "1")
        NotebookClient(notebook, timeout=600, kernel_name="python3", allow_errors=True).execute()
    return found


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_runs(name: str, cells: dict[str, list[Any]]) -> None:
    outputs = [output for cell in cells[name] for output in cell.get("outputs", [])]
    assert not [output["traceback"] for output in outputs if output["output_type"] == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    # tqdm warns of a package that a kernel without a browser does not need.
    complaint = re.compile(r"Traceback|(?<!Tqdm)Warning")
    assert not [output for output in outputs if complaint.search(output.get("text", ""))]


def test_there_are_notebooks() -> None:
    assert [name[:2] for name in NOTEBOOKS] == [f"{number:02}" for number in range(1, 9)]
