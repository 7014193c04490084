# Every target does its own set-up: `make benchmark` and `make test` work on a fresh clone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help setup setup-dev setup-docs benchmark test test-fast campaigns lint docs clean
help:
	@echo "make benchmark   drive the paper's six trajectories, print the table, write results/benchmark/report.html"
	@echo "make test        run the tests"
	@echo "make test-fast   run the tests that take little time"
	@echo "make campaigns   try to break everything for an hour or so: kills, hostile files, numbers and commands"
	@echo "make lint        ruff, mypy and the import-direction contract"
	@echo "make docs        the site, into build/site: open build/site/index.html"
	@echo "make setup       the set-up of 'make benchmark' alone (setup-dev: that of test and lint; setup-docs)"

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: install Python 3.11 or newer, or say make PYTHON=/path/to/python"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed, this is $$($(PYTHON) --version): say make PYTHON=python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/setup.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install --editable . --constraint constraints.txt
	@touch $@

$(VENV)/setup-dev.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install --editable ".[test,dev]" --constraint constraints.txt
	@touch $@ $(VENV)/setup.stamp

$(VENV)/setup-docs.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install --editable ".[docs]" --constraint constraints.txt
	@touch $@ $(VENV)/setup.stamp

setup: $(VENV)/setup.stamp
setup-dev: $(VENV)/setup-dev.stamp
setup-docs: $(VENV)/setup-docs.stamp

benchmark: setup
	$(BIN)/lpv-track benchmark --suite paper --out results/benchmark --resume

test: setup-dev
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-fast: setup-dev
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

campaigns: setup-dev
	$(BIN)/python -m tests.campaigns

lint: setup-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy examples docs/_generate
	$(BIN)/lint-imports

# Material for MkDocs prints an announcement of its successor unless it is told not to.
docs: export NO_MKDOCS_2_WARNING = 1
docs: setup-docs
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) build results .mypy_cache .ruff_cache .pytest_cache
