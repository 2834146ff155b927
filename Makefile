# `make demo` and `make test` need Python 3.11 or later and nothing else; the first run installs into $(VENV).

VENV ?= .venv
PYTHON ?=
DIR ?= autotune-demo
FUZZ_SECONDS ?= 60
SITE ?= site
JOBS ?= auto

BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check
RUNTIME := $(VENV)/.installed-runtime
DEV := $(VENV)/.installed-dev

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test test-python-kernels check lint types imports wheel docs coverage fuzz benchmarks clean

help:
	@echo "make demo        run the whole chain on the log of a simulated cell (DIR=$(DIR))"
	@echo "make test        run the tests in JOBS=$(JOBS) processes (ARGS=... goes to pytest; HYPOTHESIS_PROFILE=random tries new cases)"
	@echo "make test-python-kernels  run a few of them with the kernels as plain Python (NUMBA_DISABLE_JIT=1)"
	@echo "make check       format, lint, types, import contracts, tests, wheel content and documentation: what CI runs"
	@echo "make docs        build the documentation's site in SITE=$(SITE)"
	@echo "make coverage    run the tests and tell which lines they miss"
	@echo "make fuzz        alter messages at random for a minute (FUZZ_SECONDS=$(FUZZ_SECONDS)) and compare the reader with rosbags"
	@echo "make benchmarks  measure how long things take"
	@echo "make clean       remove the virtual environment and everything that was built"

demo: $(RUNTIME)
	@$(BIN)/autotune demo "$(DIR)"

# Every process of the tests imports the same modules: without their bytecode each would compile them anew.
test: $(DEV)
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses $(JOBS) --dist worksteal $(ARGS)

# Kernels as plain Python, as for a debugger.
PLAIN := tests/problems/contact/test_events.py tests/autotune/simulation/test_write_bags.py \
	tests/problems/stability/test_margin_kernel.py::test_neighbours_of_the_refined_response_are_within_35_degrees
test-python-kernels: $(DEV)
	@echo "== kernels as plain Python"
	@NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -q $(PLAIN)

check: lint types imports test wheel docs

lint: $(DEV)
	@echo "== format and lint"
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .

types: $(DEV)
	@echo "== types"
	@$(BIN)/mypy

imports: $(DEV)
	@echo "== import contracts"
	@$(BIN)/lint-imports --no-logo

wheel: $(DEV)
	@echo "== wheel content"
	@$(BIN)/python tools/check_wheel.py

docs: $(DEV)
	@echo "== documentation"
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --site-dir "$(SITE)"
	@echo "$(SITE)/index.html; with search: $(BIN)/python -m http.server --directory \"$(SITE)\""

coverage: $(DEV)
	@$(BIN)/python -m pytest --cov --cov-report=term-missing:skip-covered $(ARGS)

fuzz: $(DEV)
	@$(BIN)/python tools/fuzz_messages.py --seconds $(FUZZ_SECONDS)

benchmarks: $(DEV)
	@$(PIP_INSTALL) --editable '.[dev,benchmarks]'
	@for script in benchmarks/bench_*.py; do \
		echo "== $$script"; \
		$(BIN)/python "$$script" || exit 1; \
	done

clean:
	rm -rf .venv autotune-demo build dist site *.egg-info .coverage htmlcov .hypothesis
	rm -rf .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find autotune identification problems tests examples benchmarks tools -name __pycache__ -type d -prune -exec rm -rf {} +

# Installed anew when the list of dependencies changes; a change of the code needs nothing.
$(DEV): pyproject.toml $(BIN)/python
	@echo "Installing autotune and its development tools into $(VENV) (some minutes the first time) ..."
	@$(PIP_INSTALL) --editable '.[dev]'
	@touch $(RUNTIME) $(DEV)

$(RUNTIME): pyproject.toml $(BIN)/python
	@echo "Installing autotune into $(VENV) (some minutes the first time) ..."
	@$(PIP_INSTALL) --editable '.[reports]'
	@touch $(RUNTIME)

$(BIN)/python:
	@sh tools/make_venv.sh "$(VENV)" $(PYTHON)
