# Everything starts from python3, pip and make; what is installed goes to .venv and is installed once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt

BENCHMARKS := augment folder fuzz loader networks noise synth

.PHONY: demo test lint docs bench clean

demo: $(VENV)/.demo  ## train a RAW denoiser on built-in data, with and without augmentation
	$(BIN)/rawaug run recipes/fewshot.yaml

test: lint  ## style, types and all tests
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.docs
	$(BIN)/mkdocs build --strict

bench: $(VENV)/.demo  ## what things cost and what damaged files do, each benchmark quickly
	for name in $(BENCHMARKS); do $(BIN)/python -m benchmarks.$$name --quick || exit 1; done

clean:
	rm -rf $(VENV) runs build site *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: setup.cfg pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable .[all]
	touch $@

$(VENV)/.test: setup.cfg pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable .[test]
	touch $(VENV)/.demo $@

$(VENV)/.docs: setup.cfg pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable .[docs]
	touch $(VENV)/.demo $@
