# Two commands are all a newcomer needs: `make train` and `make test`; each sets itself up.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# setuptools warns of editable installs whose package lies beside pyproject.toml; ours should.
PIP := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: help train test test-all test-notebooks lint figures results bench bench-full clean

help: ## What there is
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 16

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "error: Python 3.11 or newer is needed, try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@$(PYTHON) -m venv $(VENV) \
	  || { echo "error: the venv module is missing, try: apt-get install python3-venv"; exit 2; }
	@echo "installing into $(VENV) (a minute or two)"
	@$(PIP) -e '.[dev]'
	@touch $@

train: $(STAMP) ## Train XBot-L: make train ARGS="--preset laptop --seed 1"
	@$(BIN)/python -m kslc_jax.train $(ARGS)

test: $(STAMP) ## Quick test suite, a few minutes
	@$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

test-all: $(STAMP) ## All tests, slow ones too
	@$(BIN)/python -m pytest -m "" $(ARGS)

test-notebooks: $(STAMP) ## Executes the four notebooks, shortened: a few minutes
	@$(BIN)/python -m pytest -n 2 -m "" tests/test_notebooks.py $(ARGS)

lint: $(STAMP) ## ruff and ty
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/ty check

# The commands stand in these pages, each beside what it makes.
RESULTS := docs/results.md docs/lab_notebook.md

figures: $(STAMP) ## The figures and tables of the pages again, from the data beside them: a minute
	@grep -h '^python -m kslc_jax.plots' $(RESULTS) | PATH="$(BIN):$$PATH" sh -ex
	@$(BIN)/python -m docs.tables

results: $(STAMP) ## Those data too, from the shipped policy, its gait strips and its film: half an hour
	@$(PIP) -e '.[drake]'
	@grep -hE '^python -m kslc_jax.(evaluate|sim2sim|judge|play|plots)' $(RESULTS) | PATH="$(BIN):$$PATH" sh -ex
	@$(BIN)/python -m docs.tables

bench: $(STAMP) ## Throughput of a whole training step
	@$(BIN)/python -m benchmarks.throughput --repeats 3 $(ARGS)

bench-full: $(STAMP) ## The figures of docs/performance.md, against Brax and torch too: half an hour
	@$(PIP) -e '.[bench]'
	@$(BIN)/python -m benchmarks.throughput
	@$(BIN)/python -m benchmarks.parts --out docs/profile.png
	@$(BIN)/python -m benchmarks.comparison
	@$(BIN)/python -m benchmarks.compile_time
	@$(BIN)/python -m benchmarks.memory --out docs/memory.png

clean: ## Remove the virtual environment and caches, not runs/
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis *.egg-info
