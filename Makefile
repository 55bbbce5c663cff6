# Everything starts from python3, pip and make; what is installed goes to .venv and is installed once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := PYTHONWARNINGS=ignore $(BIN)/pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
# The build backend warns of every editable installation. In compat mode it is a path, which a script beside the clone
# finds as well: there the clone's folder would be taken for a namespace package.
EDITABLE := --config-settings editable_mode=compat --editable
# pip would take 40 s to compile 16,000 modules; Python compiles the few that it meets, and keeps them.
export PYTHONDONTWRITEBYTECODE :=

# pip evaluates environment markers for the Python that runs it, whatever --python-version says; uv does not.
COMPILE := MACOSX_DEPLOYMENT_TARGET=14.0 $(BIN)/uv pip compile --quiet --no-header --no-annotate --only-binary :all:
PYTHONS := 3.11 3.12 3.13
PLATFORMS := x86_64-manylinux_2_28 aarch64-apple-darwin x86_64-pc-windows-msvc  # CUDA, CPU, CPU
WHEEL := build/resolve/requirements.in
LOCKED := \# Exact versions by Python version and platform, written by make lock. CUDA packages are pinned by torch itself.

BENCHMARKS := augment denoise faults folder forty_lines fuzz loader networks noise synth

.PHONY: help demo test pytest lint docs bench dist archive lock resolve clean

help:  ## what there is to make
	@sed -n 's/^\([a-z]*\):.*##  *\(.*\)/\1|\2/p' $(MAKEFILE_LIST) | while IFS='|' read -r target text; do printf '%-8s %s\n' "$$target" "$$text"; done

demo: $(VENV)/.demo  ## train a RAW denoiser on a simulated camera, with and without augmentation, and test it on photographs with drawn noise
	$(BIN)/rawaug run recipes/fewshot.yaml
	$(BIN)/rawaug benchmark runs/fewshot/seed0/*/denoiser.safetensors --noise cycleisp_sidd  # on photographs

test: $(VENV)/.test  ## style, types and all tests, at once
	$(MAKE) --jobs 2 lint pytest

pytest: $(VENV)/.test  ## the tests alone
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

lint: $(VENV)/.test  ## style and types alone
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python .ci/advisories.py

docs: $(VENV)/.docs  ## the site, in site/; a broken link or reference stops it
	$(BIN)/python .ci/cards.py
	$(BIN)/python .ci/figures.py
	$(BIN)/zensical build --strict --clean

bench: $(VENV)/.demo  ## what things cost and what damaged files do, each benchmark quickly
	for name in $(BENCHMARKS); do $(BIN)/python -m benchmarks.$$name --quick || exit 1; done

dist: | $(BIN)/python  ## the wheel and the source archive of a release
	$(BIN)/pip install --quiet --disable-pip-version-check build
	$(BIN)/python -m build

archive: $(VENV)/.test  ## the source archive, unpacked in build/archive, and its fast tests
	rm -rf build/archive build/rawaug-*.tar.gz && mkdir -p build/archive
	$(BIN)/python -c "from setuptools.build_meta import build_sdist; build_sdist('build')"
	tar --extract --gzip --strip-components 1 --directory build/archive --file build/rawaug-*.tar.gz
	cd build/archive && PYTHONPATH=. $(abspath $(BIN))/python -m pytest --numprocesses 2 --dist worksteal -m "not long"

lock: $(WHEEL)  ## constraints.txt anew, for every Python version and platform at once; pins that still hold stay
	$(COMPILE) --universal --python-version 3.11 --fork-strategy requires-python --output-file constraints.txt $<
	sed -i.old -E '/^(rawaug|nvidia-|cuda-)/d; 1i $(LOCKED)' constraints.txt && rm constraints.txt.old

resolve: $(WHEEL)  ## what pip would install by constraints.txt, looked up on the index and not installed
	for python in $(PYTHONS); do for platform in $(PLATFORMS); do \
	  $(COMPILE) --constraint constraints.txt --python-version $$python --python-platform $$platform $< \
	    --output-file build/resolve/$$python-$$platform.txt || exit 1; \
	  echo "Python $$python, $$platform: $$(grep -c == build/resolve/$$python-$$platform.txt) packages," \
	    $$(grep -E '^(torch|triton|rawpy|numpy)==' build/resolve/$$python-$$platform.txt); \
	done; done

clean:  ## remove everything that make writes
	rm -rf $(VENV) runs build dist site .cache *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BIN)/python:  # the pip that comes with Python 3.11 takes three times as long to find the packages
	$(PYTHON) -m venv $(VENV)
	-$(BIN)/pip install --quiet --disable-pip-version-check --upgrade pip

$(VENV)/.demo: setup.cfg pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) $(EDITABLE) .[raw,train,data]
	touch $@

$(VENV)/.test: setup.cfg pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) $(EDITABLE) .[test]
	touch $(VENV)/.demo $@

$(VENV)/.docs: setup.cfg pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) $(EDITABLE) .[docs]
	touch $(VENV)/.demo $@

$(VENV)/.uv: | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check uv
	touch $@

$(WHEEL): setup.cfg $(VENV)/.uv
	$(BIN)/pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir build/resolve .
	echo "rawaug[test,docs,openvino] @ file://$(CURDIR)/$$(ls build/resolve/rawaug-*.whl)" > $@
