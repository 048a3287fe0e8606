# In a fresh clone run `make train` or `make test`; nothing else is needed. `make help` lists all targets.
SHELL = /bin/bash
PYTHON ?= python3
VENV = .venv
BIN = $(VENV)/bin
export OMP_NUM_THREADS ?= 1

ENV ?= Pendulum
ALGO ?= tbc-hrl
SEED ?= 0
STEPS ?= $(if $(filter Pendulum,$(ENV)),100000,)
RUN := runs/$(shell date +%Y%m%d-%H%M%S)

.PHONY: help install browser train test pytest pytest-slow type lint format check-codestyle commit-checks doc notebooks torture mutation bench report pretrained lowest newest clean

help:
	@echo "install          .venv with the package (editable) and what its tests need"
	@echo "train            train TBC-HRL, evaluate it, film it, write a report [ENV= STEPS= SEED= ALGO=]"
	@echo "test             install, then the fast test suite"
	@echo "pytest           the fast tests alone        pytest-slow  all tests"
	@echo "type lint        mypy, ruff                  format       ruff format and fixes"
	@echo "check-codestyle  format and lint, no change  commit-checks format type lint"
	@echo "report           the results page of the docs and the HTML report, from the ledger in results/"
	@echo "doc notebooks    build the pages, run the notebooks        bench  steps per second"
	@echo "mutation         the share of single-line faults that the tests catch, by sample [DIGITS=1]; an hour or so"
	@echo "torture          kill, stop and damage runs, for the table of docs/reliability.md; takes hours"
	@echo "lowest newest    the tests of SB3's contract with the lowest, or the newest, supported versions"
	@echo "pretrained       train the agents that come with the package [TASKS=]"

# The stamp is newer than the files that determine what is installed, so nothing is installed twice.
$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	@scripts/system-packages.sh
	@scripts/venv.sh '$(VENV)' '$(PYTHON)'
	$(BIN)/python -m pip install --quiet --editable '.[tests]' --constraint constraints.txt
	@touch $@

install: $(VENV)/.installed

train: install
	$(BIN)/python -m sb3_tbc.train --algo $(ALGO) --env $(ENV) --seed $(SEED) $(if $(STEPS),--n-timesteps $(STEPS)) \
	    --log-folder $(RUN) --progress --trace
	-$(BIN)/python -m sb3_tbc.evaluate $(RUN)/*/*/*/*/model.zip --n-episodes 3 --video $(RUN)/episodes.mp4
	$(BIN)/python -m sb3_tbc.report $(RUN) --html $(RUN)/report.html

test: install browser pytest

browser:
	@scripts/browser.sh

pytest:
	$(BIN)/python -m pytest

pytest-slow:
	$(BIN)/python -m pytest -m "slow or not slow"

type:
	$(BIN)/mypy

lint:
	$(BIN)/ruff check .

format:
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

check-codestyle:
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

commit-checks: format type lint

doc: install
	$(BIN)/python -m pip install --quiet --editable '.[docs]' --constraint constraints.txt
	$(BIN)/sphinx-build -W -b html docs docs/_build/html

# The same ledger gives the same bytes.
report: install
	$(BIN)/python -m sb3_tbc.report results --update docs/results.md --html docs/_static/report.html \
	    --measured sb3_tbc/zoo/measured.yml

notebooks: install
	$(BIN)/python -m pytest -m "slow or not slow" tests/test_notebooks.py

mutation: install
	$(BIN)/python -m pip install --quiet --editable '.[dev]' --constraint constraints.txt
	$(BIN)/python scripts/mutation.py --digits $(or $(DIGITS),1)

torture: install
	$(BIN)/python scripts/torture.py all

bench: install
	$(BIN)/python scripts/bench.py

pretrained: install
	$(BIN)/python scripts/pretrained.py $(TASKS)
	$(BIN)/python scripts/interpretation.py

lowest newest:
	PYTHON=$(PYTHON) scripts/versions.sh $@

clean:
	rm -rf .venv-lowest .venv-newest build dist docs/_build .mypy_cache .ruff_cache .pytest_cache .hypothesis
