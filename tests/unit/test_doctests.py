"""The examples in the docstrings run."""

import doctest
import importlib
from pathlib import Path

import pytest

import memcomp_lightning

ROOT = Path(memcomp_lightning.__file__).parent
MODULES = sorted(
    ".".join(("memcomp_lightning", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
    for path in ROOT.rglob("*.py")
    if path.relative_to(ROOT).parts[0] not in ("cli", "conf")
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_the_module(name):
    result = doctest.testmod(importlib.import_module(name))
    assert result.failed == 0


def test_examples_are_found():
    """Also behind the shape checks, which wrap functions."""
    module = importlib.import_module("memcomp_lightning.enumeration")
    assert sum(len(test.examples) for test in doctest.DocTestFinder().find(module)) == 2
    assert len(MODULES) > 40
