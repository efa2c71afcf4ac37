# make demo   set up, and run the demonstration campaign to posterior, bound and figures
# make paper  set up, and run the campaign of docs/results.md: 2,483 samples on a cold simulated observation
# make report set up, and write RESULTS/report.html of a finished campaign (RESULTS=results/demo unless given)
# make docs   set up, and rewrite docs/configuration.md, the comments of config.yaml and its JSON schema
# make test   set up, and check style, types and behaviour
# make test-slurm  as root: set up, install and start a Slurm of one node, and run and kill campaigns on it
# make reliability  set up, inject every fault and write docs/reliability.md (as root with WARMLENS_TEST_SLURM=1: also
#             those of Slurm, see test-slurm; rows of faults that did not run stay)
PYTHON ?= python3
RESULTS ?= results/demo
CORES ?= $(shell getconf _NPROCESSORS_ONLN)
BIN := .venv/bin
READY := .venv/.ready
PYTEST := $(BIN)/pytest --numprocesses logical --maxprocesses 5 --no-loadscope-reorder
SNAKEMAKE := $(BIN)/snakemake --cores $(CORES) --workflow-profile workflow/profiles/local

.PHONY: demo campaign paper hst report docs test pytest test-slurm reliability lint format lock clean

demo: $(READY)
	$(SNAKEMAKE) --configfile workflow/configs/demo.yaml

campaign: $(READY)
	$(SNAKEMAKE)

paper: $(READY)
	$(BIN)/warmlens run --configfile workflow/configs/paper.yaml --cores $(CORES)

hst: $(READY)
	$(SNAKEMAKE) --configfile workflow/configs/hst.yaml

report: $(READY)
	$(BIN)/warmlens report $(RESULTS)

docs: $(READY)
	$(BIN)/warmlens config-reference

test: lint pytest

pytest: $(READY)
	$(PYTEST) --durations=25

test-slurm: $(READY)
	WARMLENS_TEST_SLURM=1 WARMLENS_TEST_FAULTS=1 $(BIN)/pytest --durations=0 tests/slurm

reliability: $(READY)
	WARMLENS_TEST_FAULTS=1 $(PYTEST) -m fault --durations=25

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --no-deps --requirement requirements.lock # of all, see lock
	$(BIN)/python -m pip install --no-deps --no-build-isolation --editable .
	touch $@

# after a change of the dependencies in pyproject.toml: resolve anew, then run the tests and commit
lock:
	rm -rf .venv-lock && $(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --editable '.[dev,slurm]'
	.venv-lock/bin/python -m pip freeze --all --exclude-editable --exclude pip > requirements.lock
	rm -rf .venv-lock

clean:
	rm -rf .venv .snakemake build src/*.egg-info
