"""What the programs of experiments and notebooks take from the package is there."""

import ast
import importlib
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PROGRAMS = sorted((ROOT / "experiments").rglob("*.py")) + sorted((ROOT / "notebooks").glob("*.ipynb"))


def code_of(program):
    if program.suffix == ".py":
        return program.read_text()
    cells = json.loads(program.read_text())["cells"]
    lines = [line for cell in cells if cell["cell_type"] == "code" for line in "".join(cell["source"]).split("\n")]
    return "\n".join(line for line in lines if not line.startswith(("%", "!")))


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: str(program.relative_to(ROOT)))
def test_each_name_that_is_imported_exists(program):
    for node in ast.walk(ast.parse(code_of(program))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "memcomp_lightning":
            module = importlib.import_module(node.module)
            for name in (alias.name for alias in node.names):
                found = hasattr(module, name) or importlib.util.find_spec(f"{node.module}.{name}")
                assert found, f"{program.name}: from {node.module} import {name}"
