# Six targets do everything on a bare machine with Python 3.11 or newer:
#   make demo    the environment, then `bayesdist demo`
#   make test    the environment with the test extra, checks of the code and the tests: some ten
#                minutes on two cores
#   make test-full  the same, with the statistical suites in full: some hours on two cores
#   make bench   the same environment, then the benchmarks: build/bench/bench.json, and
#                docs/benchmarks.md with what other pages state of it (docs/measured.toml);
#                some 10 minutes on two cores that have nothing else to do; with RELEASE=NAME the
#                ratios are kept in docs/benchmark_history.json, and drawn over time
#   make bench-check  the benchmarks alone; fails where a ratio is a fifth worse than at the release
#   make docs    the environment with the docs extra, then the site: build/docs/index.html; a
#                warning is an error
PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin

# else each process that tests and commands start compiles all modules again: seconds, dozens of times
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test types imports suite test-full docs bench bench-check lint clean

demo: $(VENV)/.installed
	$(BIN)/bayesdist demo -o demo-run --force

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) --no-print-directory -j3 types imports suite

# all at once: mypy takes a minute of one core at first, and the tests wait for each other at times
types: $(VENV)/.installed-test
	$(BIN)/mypy

imports: $(VENV)/.installed-test
	$(BIN)/lint-imports

suite: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test-full: $(VENV)/.installed-test
	BAYESDIST_FULL=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build -q -W --keep-going -n -d build/doctrees docs build/docs
	@echo build/docs/index.html

bench: $(VENV)/.installed-test
	$(BIN)/python -m tests.benchmarks --output build/bench --docs docs $(if $(RELEASE),--release $(RELEASE))

bench-check: $(VENV)/.installed-test
	$(BIN)/python -m tests.benchmarks --output build/bench --against docs/benchmark_history.json

lint: $(VENV)/.installed-test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "bayesdist needs Python 3.11 or newer; set PYTHON=/path/to/it" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) demo-run build dist
