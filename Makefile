# Two commands set up everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO ?= data/demo
# test processes; 0 = all tests in one
JOBS ?= auto

.PHONY: help install demo test check format bench bench-peers test-nojit test-boundscheck coverage kill-test fuzz cards docs wheel clean

help:  ## List the targets.
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 20

install: $(STAMP)  ## Make the virtual environment with everything that development needs.

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	touch $@

demo: $(STAMP)  ## Generate a small dataset, print its summary, load windows through a DataLoader.
	$(BIN)/navrep-data generate --env soadrl --n 20 --out $(DEMO)
	$(BIN)/navrep-data info $(DEMO)
	$(BIN)/python examples/load_windows.py $(DEMO)

test: $(STAMP)  ## Run the whole test suite, slow tests included.
	$(BIN)/python -m pytest -m "slow or not slow" --numprocesses $(JOBS) --dist loadscope --no-loadscope-reorder $(PYTEST_ARGS)

check: $(STAMP)  ## Format, lint, types, import contracts.
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)  ## Format and fix what can be fixed.
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

KERNEL_TESTS := tests/sim tests/observations tests/policies

test-nojit: $(STAMP)  ## Run the kernel tests as plain Python.
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest $(KERNEL_TESTS) --numprocesses $(JOBS) $(PYTEST_ARGS)

test-boundscheck: $(STAMP)  ## Run the kernel tests with every array index checked.
	NUMBA_BOUNDSCHECK=1 $(BIN)/python -m pytest $(KERNEL_TESTS) --numprocesses $(JOBS) $(PYTEST_ARGS)

coverage: $(STAMP)  ## Line coverage of sim and observations, measured on plain Python.
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest $(KERNEL_TESTS) --numprocesses $(JOBS) --cov=navrep_data.sim --cov=navrep_data.observations \
	  --cov-report=term --cov-fail-under=95 $(PYTEST_ARGS)

kill-test: $(STAMP)  ## 200 random SIGKILLs of generate (CI runs 4).
	NAVREP_DATA_KILLS=200 $(BIN)/python -m pytest -m slow tests/generate/test_kill.py -s

# seconds in all; FUZZ_ARGS="--only shard map" for some readers, --seed N to see a finding again
SECONDS ?= 600

fuzz: $(STAMP)  ## Fuzz every reader of files from outside for SECONDS=600, with a fresh seed.
	$(BIN)/python tests/fuzz/fuzz.py --seconds $(SECONDS) $(FUZZ_ARGS)

BENCHMARKS := run zoo envs scale training

bench: $(STAMP)  ## Measure speed and size; writes benchmarks/RESULTS.md.
	failed=0; for script in $(BENCHMARKS); do $(BIN)/python benchmarks/$$script.py --write || failed=1; done; exit $$failed

bench-peers: $(STAMP)  ## Measure other simulators beside ours; writes benchmarks/RESULTS.md.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev,peers]"
	$(BIN)/python benchmarks/peers.py --write

PUBLISHED ?= data/published

cards: $(STAMP)  ## Generate the datasets that we publish; writes their cards and pictures into cards/datasets.
	$(BIN)/python tools/dataset_cards.py cards/datasets --data $(PUBLISHED)

docs: $(STAMP)  ## Build the documentation site into site/; any warning is an error.
	rm -rf site
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --fresh-env -d build/doctrees -b html docs site

wheel: $(STAMP)  ## Build the wheel into dist/.
	rm -rf dist
	$(BIN)/python -m build --wheel --outdir dist .

clean:  ## Remove the virtual environment and everything built.
	rm -rf $(VENV) dist build site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .coverage*
