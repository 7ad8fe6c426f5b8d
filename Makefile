# `make help` lists the targets. The virtual environment is created on first use.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
# Python compiles what it imports, which is a small part of what is installed.
INSTALL = $(BIN)/python -m pip install -qq --no-compile --disable-pip-version-check -c constraints.txt
# Test processes: the suite is limited by the CPU, and small machines have two cores.
JOBS   ?= 2

# Where it is set, as in many containers, every process would compile PyTorch and Lightning anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-pythons test-latest documents lint format bench clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s%s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(BIN)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) torch==2.13.0 hatchling editables
	$(INSTALL) --no-build-isolation -e '.[dev]'
	$(BIN)/python scripts/compile_kernels.py
	touch $@

setup: $(BIN)/.installed ## Create the virtual environment with pinned versions, compile kernels

demo: setup ## Train two models for a minute, print their table; a person from four photographs
	PATH="$(abspath $(BIN)):$$PATH" bash scripts/demo.sh

test: setup ## Run the whole test suite (CPU)
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal

test-pythons: ## Run it on the oldest and the newest Python (those that are installed)
	bash scripts/test_pythons.sh

LATEST = .venv-latest/bin/python -m pip install -qq --no-compile -U
test-latest: ## Run it on the newest of every package, Hydra's release candidate included
	$(PYTHON) -m venv .venv-latest
	$(LATEST) torch hatchling editables
	$(LATEST) --no-build-isolation -e '.[dev]'
	$(LATEST) --pre hydra-core omegaconf
	.venv-latest/bin/python -m pip list
	.venv-latest/bin/python -m pytest -n $(JOBS) --dist worksteal

documents: setup ## Run every command of README and docs, with small settings (minutes)
	$(BIN)/python scripts/check_documents.py

lint: setup ## Check style, and which part imports which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

format: setup ## Correct style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup ## Measure the presets of skip on built-in people, and the rasterizer (minutes)
	$(BIN)/ghgs benchmark data=synthetic data.people.train=1 data.people.val=4
	$(BIN)/python benchmarks/rasterizer.py

clean: ## Remove the virtual environment and caches, keep runs
	rm -rf $(VENV) .venv-* .pytest_cache .ruff_cache .hypothesis
