# make train      train on the digits that ship with scikit-learn: a first run
# make check      linters, types, unit and exact tests: while you work
# make test       the whole suite: what CI runs
# make lint       linters and types alone
# make docs       the site, into site/
# make versioned-docs  the same into the branch gh-pages, beside those of earlier versions
# make notebooks  the notebooks in Jupyter
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: train check test lint lint-but-types types unit-and-exact whole-suite docs versioned-docs notebooks

train: $(VENV)/.installed
	$(BIN)/memcomp-train data=digits sampler=dmm_qubo

# mypy needs one processor for as long as the kernels are compiled on the other.
check: lint-but-types
	@$(MAKE) --no-print-directory --jobs 2 types unit-and-exact

test: lint-but-types
	@$(MAKE) --no-print-directory --jobs 2 types whole-suite

lint: lint-but-types types

lint-but-types: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/.installed-dev
	$(BIN)/mypy

# A thread a worker; what one process has compiled, the others read.
unit-and-exact whole-suite: export OMP_NUM_THREADS = 1
unit-and-exact whole-suite: export PYTHONDONTWRITEBYTECODE =
unit-and-exact: $(VENV)/.installed-dev
	$(BIN)/pytest tests/exact tests/unit

whole-suite: $(VENV)/.installed-dev
	$(BIN)/pytest

# Strictly: a broken link or an unknown name ends it. The variable silences an advertisement.
docs: $(VENV)/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean

# A folder for each minor version; people land in that of the last release. Nothing is pushed.
versioned-docs: $(VENV)/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mike deploy --update-aliases \
		"$$($(BIN)/python -c 'from memcomp_lightning import __version__; print(__version__.rpartition(".")[0])')" latest
	$(BIN)/mike set-default latest

# Opens the text notebooks in Jupyter; what is changed there goes back into the text.
notebooks: $(VENV)/.installed
	$(PIP) --editable '.[notebooks]'
	$(BIN)/jupytext --to ipynb --update notebooks/*.py
	$(BIN)/jupyter lab notebooks

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --editable '.[dev]'
	touch $@ $(VENV)/.installed
