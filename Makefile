# make train: train on the digits that ship with scikit-learn.   make test: everything CI checks.   make docs: the site.
# make notebooks: Jupyter.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: train test lint docs notebooks

train: $(VENV)/.installed
	$(BIN)/memcomp-train data=digits sampler=dmm_qubo

# A thread a worker.
test: export OMP_NUM_THREADS = 1
test: $(VENV)/.installed-dev lint
	$(BIN)/pytest

# Opens the text notebooks in Jupyter; what is changed there goes back into the text.
notebooks: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[notebooks]'
	$(BIN)/jupytext --to ipynb --update notebooks/*.py
	$(BIN)/jupyter lab notebooks

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Strictly: a broken link or an unknown name ends it. The variable silences an advertisement.
docs: $(VENV)/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@ $(VENV)/.installed
