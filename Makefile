# make demo    simulate two robots' raw logs, build their common map, say how far from the truth
# make test    the tests            make check   ruff and mypy
# make bench   the benchmarks       make docs    the pages made from tables, and all links
PYTHON ?= python3
VENV ?= .venv
DEMO_OUT ?= demo-out
PYTEST_ARGS ?=

BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
WITH_TESTS := $(VENV)/.installed-test
WITH_BENCH := $(VENV)/.installed-bench

.PHONY: help demo test check bench docs install clean
.DELETE_ON_ERROR:

help:
	@sed -n 's/^# //p' Makefile

demo: $(INSTALLED)
	$(BIN)/commonmap demo -o $(DEMO_OUT)

test: $(WITH_TESTS)
	$(BIN)/python -m pytest $(PYTEST_ARGS)

check: $(WITH_TESTS)
	$(BIN)/ruff check src tests benchmarks
	$(BIN)/ruff format --check src tests
	$(BIN)/mypy

bench: $(WITH_BENCH)
	@set -e; for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script; done

docs: $(WITH_TESTS)
	$(BIN)/python docs/build.py

install: $(INSTALLED)

clean:
	rm -rf $(DEMO_OUT) build dist .mypy_cache .ruff_cache .hypothesis

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "commonmap needs Python 3.11 or newer; '$(PYTHON)' is older or missing." \
	       "Say which to use: make PYTHON=python3.12 demo"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "This Python has no venv module; on Debian and Ubuntu: sudo apt install python3-venv"; \
	  exit 1; }
	$(PYTHON) -m venv $(VENV)

$(INSTALLED): pyproject.toml src/commonmap/version.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(WITH_TESTS): pyproject.toml src/commonmap/version.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $(INSTALLED) $@

$(WITH_BENCH): pyproject.toml src/commonmap/version.py | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test,bench]'
	@touch $(INSTALLED) $(WITH_TESTS) $@
