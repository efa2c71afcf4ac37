# make demo   set up, and run the demonstration campaign to posterior, bound and figures
# make test   set up, and check style, types and behaviour
PYTHON ?= python3
CORES ?= $(shell getconf _NPROCESSORS_ONLN)
BIN := .venv/bin
READY := .venv/.ready
SNAKEMAKE := $(BIN)/snakemake --cores $(CORES) --workflow-profile workflow/profiles/local

.PHONY: demo campaign hst test lint format lock clean

demo: $(READY)
	$(SNAKEMAKE) --configfile workflow/configs/demo.yaml

campaign: $(READY)
	$(SNAKEMAKE)

hst: $(READY)
	$(SNAKEMAKE) --configfile workflow/configs/hst.yaml

test: lint
	$(BIN)/pytest --durations=10

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --requirement requirements.lock
	$(BIN)/python -m pip install --no-deps --no-build-isolation --editable .
	touch $@

# after a change of the dependencies in pyproject.toml: resolve anew, then run the tests and commit
lock:
	rm -rf .venv-lock && $(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --editable '.[dev]'
	.venv-lock/bin/python -m pip freeze --all --exclude-editable --exclude pip > requirements.lock
	rm -rf .venv-lock

clean:
	rm -rf .venv .snakemake build src/*.egg-info
