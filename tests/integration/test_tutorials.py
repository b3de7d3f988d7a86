"""The tutorials run as they stand: their Python, and their commands, in one folder."""

import re
import shlex
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
from running import Outcome

DOCS = Path(__file__).parents[2] / "docs"
PAGES = [page for page in sorted(DOCS.glob("*.md")) if "```console\n" in page.read_text()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
@pytest.mark.filterwarnings("ignore::UserWarning")  # Lightning's advice on loggers
def test_a_tutorial_runs(page: Path, run_command: Callable[..., Outcome], tmp_path: Path) -> None:
    for kind, block in re.findall(r"```(python|console)\n(.*?)```", page.read_text(), flags=re.DOTALL):
        if kind == "python":
            exec(compile(block, str(page), "exec"), {"__name__": "documentation"})
            continue
        for line in block.replace("\\\n", " ").splitlines():
            command, *arguments = shlex.split(line, comments=True)
            main = import_module(f"memcomp_lightning.cli.{command.removeprefix('memcomp-')}").main
            quick = ["callbacks=minimal", "logger=none"] if command == "memcomp-train" else []
            if any(argument.startswith("finetune.iterations=") for argument in arguments):
                quick.append("finetune.iterations=10")
            found = run_command(command, main, (*arguments, *quick))
            assert found.status == 0, f"{line}\n{found.err}"


def test_there_are_tutorials() -> None:
    assert {"tables", "ising"} <= {page.stem for page in PAGES}
