# make demo       install, train GRBM on the embedded data set, print the per-region table
# make test       install, lint-free default test suite (offline, two cores, minutes)
# make test-all   the slow tests as well
# make lint       formatting, lint, types
# make bench      benchmarks, as ratios measured in one run

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test test-all lint bench

demo: $(VENV)/.ready
	$(BIN)/python -m rgbt.run +experiment=grbm

test: $(VENV)/.ready
	$(BIN)/python -m pytest -m "not slow and not benchmark"

test-all: $(VENV)/.ready
	$(BIN)/python -m pytest -m "not benchmark"

lint: $(VENV)/.ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(VENV)/.ready
	for file in tests/benchmarks/bench_*.py; do echo "== $$file"; $(BIN)/python -m tests.benchmarks.$$(basename $$file .py) || exit 1; done

$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@
