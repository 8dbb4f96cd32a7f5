# make demo       install rgbt, train GRBM on the embedded data set, print the per-region table
# make test       install the tools too, lint-free default test suite (offline, two cores, minutes)
# make test-all   every test: the slow ones, the pages, SLURM, Ray and an MLflow server on loopback
# make lint       formatting, lint, types, spelling
# make results  rewrites docs/results, its figures and the marked numbers from the archive results/
# make docs       checks the pages and their code, builds the site (make site: alone)
# make mutants    named faults (tests/mutants/*.yaml), each of which a test has to find
# make bench      benchmarks, as ratios measured in one run
# make gpu-check  what a GPU does with a training step of the papers' size, in at most six minutes

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# An empty value lets Python keep compiled modules: the tests start many processes.
export PYTHONDONTWRITEBYTECODE :=

# Up to four processes, each with modules of its own. A process that has nothing left takes tests from
# the end of another's list, so that tests of a module mostly stay together and share its fixtures.
# `make test SPREAD=` runs one after the other.
SPREAD ?= -n auto --maxprocesses 4 --dist worksteal

# What is spelled: tests misspell names on purpose.
TEXTS := README.md CONTRIBUTING.md CHANGELOG.md CITATION.cff docs conf rgbt sweeps analysis hydra_plugins

# Pages written by hand with numbers between <!-- results:... --> and <!-- /results -->.
MARKED := README.md,docs/results/findings.md,docs/results/spatial-bias.md

# A terminal shows pip's bars; a log, what was installed and how long it took.
INSTALL = begin=$$(date +%s); if [ -t 1 ]; then quiet=; else quiet=--quiet; fi; \
	$(BIN)/python -m pip install $$quiet --disable-pip-version-check -c constraints.txt
INSTALLED = echo "Installed in $$(( $$(date +%s) - begin )) s, $$(du -sh $(VENV) | cut -f1)."

# gpu-check with BIN=/some/env/bin uses that environment, and installs nothing.
READY := $(if $(filter command line,$(origin BIN)),,$(VENV)/.ready)

.PHONY: demo test test-all lint docs site results mutants bench gpu-check

demo: $(VENV)/.installed
	$(BIN)/python -m rgbt.run +experiment=grbm

test: $(VENV)/.ready
	$(BIN)/python -m pytest $(SPREAD) -m "not slow and not docs"

# TESTS=... selects some. Some tests start a SLURM, which the first call installs where it is missing;
# where it cannot be installed, they are skipped and say so.
test-all: $(VENV)/.ready
	@PATH="$$PATH:/usr/sbin"; command -v slurmctld >/dev/null && command -v munged >/dev/null || { \
	  echo "SLURM is missing; installing the Debian packages"; \
	  if [ "$$(id -u)" = 0 ]; then as=; else as="sudo -n"; fi; \
	  $$as apt-get update -qq && $$as apt-get install -y -qq --no-install-recommends slurm-wlm munge \
	  || echo "SLURM could not be installed: its tests are skipped"; }
	$(BIN)/python -m pytest $(SPREAD) $(TESTS)

lint: $(VENV)/.ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/codespell $(TEXTS)

docs: $(VENV)/.ready
	$(BIN)/python -m pytest $(SPREAD) -m "docs and not slow" tests/docs
	$(MAKE) site

site: $(VENV)/.ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "built site/index.html; with search: $(BIN)/python -m http.server --directory site"

# Runs of this machine do not count: the pages are those of the archive alone.
results: $(VENV)/.ready
	$(BIN)/python -m sweeps.report format=markdown runs_dir=none archive=results out=docs/results "fill=$(MARKED)"

mutants: $(VENV)/.ready
	$(BIN)/python -m tests.mutants

bench: $(VENV)/.ready
	for file in tests/benchmarks/bench_*.py; do echo "== $$file"; $(BIN)/python -m tests.benchmarks.$$(basename $$file .py) || exit 1; done

# RELEASE=/code/CRM_RGBTSeg measures the step of that checkout, too; WORDS="minutes=20 rows=compiled".
gpu-check: $(READY)
	$(BIN)/python -m tests.benchmarks.gpu_check $(if $(RELEASE),release=$(RELEASE)) $(WORDS)

# What a user needs; `.ready` has the tools of the tests and the pages on top.
$(VENV)/.installed: pyproject.toml constraints.txt
	@echo "Installing rgbt into $(VENV): two to ten minutes, about 2 GB; once."
	$(PYTHON) -m venv $(VENV)
	@$(INSTALL) -e . && $(INSTALLED)
	touch $@

$(VENV)/.ready: pyproject.toml constraints.txt
	@echo "Installing rgbt and its tools into $(VENV): two to ten minutes, about 3 GB; once."
	$(PYTHON) -m venv $(VENV)
	@$(INSTALL) -e ".[dev]" && $(INSTALLED)
	touch $(VENV)/.installed $@
