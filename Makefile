# Everything runs on a bare machine with Python 3.11 or newer:
#   make demo    the environment, then `bayesdist demo`
#   make test    the environment with the test extra, checks of the code and the tests: some ten
#                minutes on two cores
#   make core    tests of the core while all kinds, file formats and missions are hidden
#   make types   mypy, in an environment of its own whose versions are exact (.ci/types.txt): what a
#                new release of numpy or mypy thinks of the code fails nobody's `make test`
#   make ci      `make test` and `make types` at once, as .ci/run does
#   make test-matrix  `make demo` and `make test` in clones, for each Python from 3.11 on that is
#                found, with the newest dependencies and, on 3.11, the oldest: an hour
#   make coverage  the tests, and which lines they reach: build/coverage/index.html
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
TYPES  ?= .venv-types
BIN     = $(VENV)/bin
# ten times as fast as pip, which is the fallback: uv does not read the mirrors that pip is told of
UV      = $(BIN)/uv pip install --quiet --python
PIP     = -m pip install --quiet --disable-pip-version-check

# else each process that tests and commands start compiles all modules again: seconds, dozens of times
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test ci style types imports suite core test-full test-matrix coverage docs bench bench-check \
        lint clean

demo: $(VENV)/.installed
	$(BIN)/bayesdist demo -o demo-run --force

test: style
	$(MAKE) --no-print-directory -j2 imports suite
	$(MAKE) --no-print-directory core

# all at once: mypy takes a minute of one core at first, and the tests wait for each other at times
ci: style
	$(MAKE) --no-print-directory -j3 types imports suite
	$(MAKE) --no-print-directory core

style: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(TYPES)/.installed
	$(TYPES)/bin/mypy

imports: $(VENV)/.installed-test
	$(BIN)/lint-imports

suite: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# The core works without kinds, formats and missions. These take half a minute; all rooms are
#   make core CORE="utils files model data products calibration simulate infer diagnose assess"
CORE = test_core.py utils model products
core: $(VENV)/.installed-test
	BAYESDIST_PLUGINS= $(BIN)/python -m pytest -q $(addprefix tests/,$(CORE))

test-full: $(VENV)/.installed-test
	BAYESDIST_FULL=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# with arguments: make test-matrix ONLY="3.13-newest 3.11-oldest"
test-matrix:
	$(PYTHON) -m tests.matrix $(ONLY)

# loops that numba compiles are not seen, and processes that tests start are
coverage: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder \
	  --cov --cov-report=term:skip-covered --cov-report=html:build/coverage

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
	$(BIN)/python $(PIP) uv || true

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(UV) $(BIN)/python -e . || $(BIN)/python $(PIP) -e .
	@touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(UV) $(BIN)/python -e '.[test]' || $(BIN)/python $(PIP) -e '.[test]'
	@touch $@ $(VENV)/.installed

$(TYPES)/.installed: .ci/types.txt | $(BIN)/python
	$(BIN)/python -m venv $(TYPES)
	$(UV) $(TYPES)/bin/python --only-binary :all: --requirement .ci/types.txt \
	  || $(TYPES)/bin/python $(PIP) --only-binary :all: --requirement .ci/types.txt
	@touch $@

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(UV) $(BIN)/python -e '.[docs]' || $(BIN)/python $(PIP) -e '.[docs]'
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) $(TYPES) demo-run build dist
