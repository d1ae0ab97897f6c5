# make demo   the sample clip through the main job, results in demo-out/
# make test   what CI runs: ruff, format, types, tests
# Both need Python 3.11 (to 3.13), git and make; everything else goes into .venv.

# Which interpreter makes .venv: a python3.11 that runs (a launcher stub may be on the path without one), else python3.
PYTHON ?= $(shell python3.11 -c "" 2>/dev/null && echo python3.11 || echo python3)
# What pip installs for torch, before the project, so that nothing else picks a build. Where torch comes from is pip's
# configuration: the README says how to get a CPU or a GPU build.  make demo TORCH=torch==2.12.0
TORCH ?= torch==2.13.0
# Two workers; whole files go to one of them, because a file's tests share what it has set up. PYTEST_ARGS= for one.
PYTEST_ARGS ?= -n 2 --dist loadfile

BIN := .venv/bin
STAMP := .venv/.installed
# A cold check takes 54 s of processor time, of which benchmarks and tests/synth are 6.
TYPED := mosaic calib pipelines $(wildcard benchmarks/*.py) tests/synth

# The viewer that a test opens our Deep Zoom tiles with (BSD). npm puts it beside the interpreter; without npm, or without
# its registry, that one test is skipped.
OPENSEADRAGON := openseadragon@6.1.1
VIEWER := .venv/node_modules/.$(OPENSEADRAGON)

.PHONY: demo test lint format clean
.DEFAULT_GOAL := test

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14) and "Python 3.11, 3.12 or 3.13 is needed: make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet "$(TORCH)"
	$(BIN)/python -m pip install --quiet --editable . --group dev
	$(BIN)/python -m pip check
	touch $@

demo: $(STAMP)
	$(BIN)/broadcast-mosaic demo -o demo-out

$(VIEWER): | $(STAMP)
	@if ! command -v npm >/dev/null; then echo "npm is not installed: the test in OpenSeadragon will be skipped"; \
	elif npm install --prefix .venv --no-save --ignore-scripts --no-audit --no-fund --loglevel=error $(OPENSEADRAGON); then touch $@; \
	else echo "npm could not install $(OPENSEADRAGON): the test in OpenSeadragon will be skipped"; fi

test: lint $(VIEWER)
	$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy $(TYPED)

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build dist demo-out .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
