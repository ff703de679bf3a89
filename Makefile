# Needs python3 (3.11 or later) and make; everything else goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: run test clean

# simulate, measure and score the quick scenario; shows where the report is
run: $(VENV)/.installed
	$(BIN)/pdvc-bench run quick -o out/quick

# play the simulated test "quick" as a scanner writes it, and show it on a page; ends with the test, or with Ctrl-C
.PHONY: live
live: $(VENV)/.installed
	$(BIN)/python examples/follow_a_test.py out/live

# format, lint, types, tests
test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 --dist loadfile

clean:
	rm -rf $(VENV) build

# the stamps are younger than pyproject.toml while what is installed is what it asks for
$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[all]'
	touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@ $(VENV)/.installed

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "expected Python 3.11 or later, found: $$($(PYTHON) --version 2>&1)"; exit 1; }
	$(PYTHON) -m venv $(VENV)

# build the site into build/docs: pages of docs/, the API from the docstrings, the picture of the rooms. Warnings are
# errors, links and anchors are checked. Makes an environment of its own, with the extra `docs`
.PHONY: docs
docs: .venv-docs/.installed
	.venv-docs/bin/python docs/figures/architecture.py
	.venv-docs/bin/sphinx-build -q -W --keep-going -d build/doctrees -c docs/site docs build/docs
	.venv-docs/bin/python docs/site/check.py build/docs

.venv-docs/.installed: pyproject.toml
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $@

# which lines and branches the tests reach; the page is build/coverage/index.html. Longer than `make test`. Compiled
# kernels do not show: their lines count as missed, though tests/test_projection.py and others go through them.
# TESTS="tests/test_geometry.py" takes some files only
.PHONY: coverage
TESTS ?= tests
coverage: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist loadfile --cov --cov-report=term:skip-covered --cov-report=html $(TESTS)

# time every stage, beside RTK and beside a plain implementation: one table. Makes an environment of its own, with the
# extra `bench` (itk-rtk, 1.75 GB installed); RTK itself takes half a minute to load, and the whole some ten minutes
.PHONY: bench
bench: .venv-bench/.installed
	.venv-bench/bin/python -m benchmarks.table

.venv-bench/.installed: pyproject.toml
	@echo "installing the extra 'bench' (itk-rtk, 1.75 GB) into .venv-bench; without it: $(BIN)/python -m benchmarks.table"
	$(PYTHON) -m venv .venv-bench
	echo '*' > .venv-bench/.gitignore
	.venv-bench/bin/pip install --quiet --disable-pip-version-check --editable '.[bench]'
	touch $@

# give some two hundred bad inputs to the command line, and write docs/bad-inputs.md; fails while any is not answered
.PHONY: bad-inputs
bad-inputs: $(VENV)/.installed
	$(BIN)/python -m benchmarks.bad_inputs

# every law of the tests on EXAMPLES examples, those through the whole pipeline on a tenth; tells how many were tried
.PHONY: laws
EXAMPLES ?= 300
laws: $(VENV)/.installed-test
	PDVC_LAW_EXAMPLES=$(EXAMPLES) $(BIN)/python -m pytest -m hypothesis -n 2 --dist worksteal

# plant MUTANTS faults, drawn by SEED, one after the other in a copy of the project, for MINUTES at most, and run the
# tests of each fault's module: docs/mutants.md. Makes an environment of its own, with the extra `mutants`
.PHONY: mutants
MUTANTS ?= 60
MINUTES ?= 25
SEED ?= 1
mutants: .venv-mutants/.installed
	.venv-mutants/bin/python -m tests.mutants --mutants $(MUTANTS) --minutes $(MINUTES) --seed $(SEED)

.venv-mutants/.installed: pyproject.toml
	$(PYTHON) -m venv .venv-mutants
	.venv-mutants/bin/pip install --quiet --disable-pip-version-check --editable '.[mutants]'
	touch $@

# kill commands at random moments and give them again; fuzz folders and TOML with fifty times the examples of the
# tests. Some hours on 2 cores; docs/faults.md holds a result
.PHONY: faults
faults: $(VENV)/.installed-test
	$(BIN)/python -m benchmarks.faults
	FUZZ=50 $(BIN)/python -m pytest tests/test_fuzz.py
