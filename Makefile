# Every target does its own set-up: `make benchmark` and `make test` work on a fresh clone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
comma := ,
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help setup setup-dev setup-docs benchmark test test-fast test-lowest test-newest campaigns \
  lint docs lock clean
help:
	@echo "make benchmark   drive the paper's six trajectories and the suite limits, print both tables, write results/*/report.html"
	@echo "make test        run the tests"
	@echo "make test-fast   run the tests that take little time"
	@echo "make test-lowest test-newest   the same with the lowest and newest versions of all packages"
	@echo "make campaigns   try to break everything for an hour or so: kills, hostile files, numbers and commands"
	@echo "make lint        ruff, mypy and the import-direction contract"
	@echo "make docs        the site, into build/site: open build/site/index.html"
	@echo "make setup       the set-up of 'make benchmark' alone (setup-dev: that of test and lint; setup-docs)"
	@echo "make lock        the lists of packages with hashes in requirements/, from constraints.txt"

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: install Python 3.11 or newer, or say make PYTHON=/path/to/python"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed, this is $$($(PYTHON) --version): say make PYTHON=python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV)

# Every file that pip installs has a hash in requirements/, which pip checks; `make lock` writes
# these lists. The project itself is installed as it lies here. Only where torch is a CUDA build are
# packages left that it brings by itself.
define install
	$(PIP) install --require-hashes --no-deps --requirement requirements/$(1).txt
	$(PIP) install --no-build-isolation --no-deps --editable .
	@$(PIP) check >/dev/null || { echo "what else this platform needs, without hashes:"; \
	  $(PIP) install --editable ".$(2)" --constraint constraints.txt; }
endef

$(VENV)/setup.stamp: pyproject.toml requirements/run.txt | $(BIN)/python
	$(call install,run,[plants])
	@touch $@

$(VENV)/setup-dev.stamp: pyproject.toml requirements/dev.txt | $(BIN)/python
	@$(PIP) install --require-hashes --no-deps --requirement requirements/torch-cpu.txt 2>/dev/null || true
	$(call install,dev,[test$(comma)dev])
	@touch $@ $(VENV)/setup.stamp

$(VENV)/setup-docs.stamp: pyproject.toml requirements/docs.txt | $(BIN)/python
	$(call install,docs,[docs])
	@touch $@ $(VENV)/setup.stamp

setup: $(VENV)/setup.stamp
setup-dev: $(VENV)/setup-dev.stamp
setup-docs: $(VENV)/setup-docs.stamp

benchmark: setup
	$(BIN)/lpv-track benchmark --suite paper --out results/benchmark --resume
	$(BIN)/lpv-track benchmark --suite limits --out results/limits --resume

test: setup-dev
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-fast: setup-dev
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# In environments of their own. torch stays at its tested version: its wheels are large.
VERSIONS_lowest := --resolution lowest-direct
VERSIONS_newest := --resolution highest
test-lowest test-newest: test-%: setup-dev
	$(PIP) install uv
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python build/$*
	grep '^torch==' constraints.txt > build/$*/override.txt
	$(BIN)/uv pip install --quiet --python build/$* $(VERSIONS_$*) --override build/$*/override.txt \
	  $(patsubst %,--find-links %,$(PIP_FIND_LINKS)) --editable ".[test,dev]"
	NUMBA_CACHE_DIR=build/$*/cache build/$*/bin/python -m pytest -n 2 --dist worksteal -m "not slow"

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

lock: $(BIN)/python
	$(PIP) install uv
	$(BIN)/python requirements/lock.py

clean:
	rm -rf $(VENV) build results .mypy_cache .ruff_cache .pytest_cache
