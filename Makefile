# Set-up needs Python >= 3.11 with venv and pip; everything else goes into .venv.
PYTHON ?= python3
# Tests run on this many processes; MARK selects them (pytest -m), empty for all. Each process takes a part in order, so
# that what the tests of a file share is made once; one that has none left takes some of another's.
JOBS ?= 2
MARK ?= not long

BIN := .venv/bin
export UV_PYTHON_DOWNLOADS := never
INSTALL := $(BIN)/uv pip install --quiet --python $(BIN)/python \
	--constraints constraints.txt --build-constraints constraints.txt --editable .
# The wheel is built from the sdist, which so proves to be whole. Its machine code takes some minutes.
BUILD := $(BIN)/uv build --quiet --python $(BIN)/python --build-constraints constraints.txt

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test versions door bench peers robustness avoidance network day evening exports replays docs package lint format constraints clean

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' Makefile

setup: .venv/.core .venv/.dev  ## Make .venv with all that development needs

demo: .venv/.core  ## Fly the paper's narrow passage
	@$(BIN)/rigidfleet run narrow-passage --force --replay

test: .venv/.dev  ## Run the tests (MARK= runs the long ones, too)
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "$(MARK)"

versions: .venv/.uv  ## Fly with the lowest versions and the newest, on every Python found
	@$(BIN)/python tests/versions.py

door: .venv/.dev  ## Give 2,000 mutants of known flights to `assess`
	@$(BIN)/python tests/door.py

bench: .venv/.vehicles  ## Measure the speed, as ratios
	@$(BIN)/python benchmarks/run.py
	@$(BIN)/python benchmarks/many.py
	@$(BIN)/python benchmarks/vehicles.py
	@$(BIN)/python benchmarks/wheel.py

peers: .venv/.peers  ## Fly beside other programs (Octave, too, if it is on PATH)
	@$(BIN)/python benchmarks/compare.py

robustness: .venv/.core  ## Fly 200 random formations under every graph and law
	@$(BIN)/python benchmarks/robustness.py --write docs/robustness.md

network: .venv/.core  ## Fly formations over networks that lose and delay (half an hour)
	@$(BIN)/python benchmarks/network.py --write docs/network.md

day: .venv/.oracles .venv/.interchange .venv/.dev  ## Rehearse and abort shows of a thousand, against oracles (six minutes)
	@$(BIN)/python benchmarks/day.py --write docs/day.md

evening: .venv/.core  ## Judge logs of which the truth is known (half an hour)
	@$(BIN)/python benchmarks/evening.py --write docs/logs.md

exports: .venv/.interchange  ## Measure every export of three flights
	@$(BIN)/python benchmarks/exports.py --write docs/export.md

avoidance: .venv/.crowds  ## Plan transitions and published problems, with proofs
	@$(BIN)/python benchmarks/avoidance.py
	@$(BIN)/python benchmarks/moving.py
	@$(BIN)/python benchmarks/order.py
	@$(BIN)/python benchmarks/gaps.py
	@$(BIN)/python benchmarks/crowds.py
	@$(BIN)/python benchmarks/reciprocal.py
	@$(BIN)/python benchmarks/encounters.py

replays: .venv/.dev  ## Measure replays in Chromium without a graphics card
	@$(BIN)/python benchmarks/replay.py

docs: .venv/.docs  ## Build the site into site/, with every figure on it
	@$(BIN)/python docs/picture.py
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "Open site/index.html"

package: .venv/.uv  ## Build the wheel and the sdist into dist/
	@rm -rf dist
	@$(BUILD) --out-dir dist .

lint: .venv/.dev  ## Check style, types and import layers
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/ty check --no-progress
	@$(BIN)/lint-imports --no-cache --no-logo

format: .venv/.dev  ## Rewrite the code in the project's style
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

constraints: .venv/.dev  ## Choose newer versions of all packages, and the lowest that are declared
	@$(BIN)/uv pip compile --quiet --universal --upgrade --no-header --no-annotate \
		--all-extras --group dev --group peers --group crowds --group vehicles --group interchange --group oracles --group docs --group build \
		pyproject.toml --output-file constraints.txt
	@$(BIN)/uv pip compile --quiet --python-version 3.11 --resolution lowest-direct --upgrade --no-header --no-annotate \
		--all-extras pyproject.toml --output-file constraints-lowest.txt

clean:  ## Remove .venv, caches and builds
	@rm -rf .venv .pytest_cache .ruff_cache .import_linter_cache build dist site
	@find src tests -type d -name __pycache__ -prune -exec rm -rf {} +

.venv/.uv: constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; print("Setting up .venv with Python", v) \
		if sys.version_info >= (3, 11) else sys.exit("rigidfleet needs Python 3.11 or newer, this is " \
		+ v + ". Name another one: make PYTHON=/path/to/python")'
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt uv
	@touch $@

.venv/.core: .venv/.uv pyproject.toml constraints.txt
	@echo "Installing rigidfleet and what it needs"
	@$(INSTALL)
	@touch $@

.venv/.dev .venv/.peers .venv/.crowds .venv/.vehicles .venv/.interchange .venv/.oracles .venv/.docs: .venv/.%: .venv/.core
	@echo "Installing what '$*' needs"
	@$(INSTALL) --group $*
	@touch $@
