# Needs make and Python 3.11 or newer; everything else goes into .venv. Another interpreter: make demo PYTHON=python3.12
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
# Words for pytest and the benches: make test ARGS="-k frame"; make bench ARGS="frame --device cuda:0"
ARGS ?=
SOURCES := warp_deferred kernels scenes tests $(wildcard bench)

.DEFAULT_GOAL := help
.PHONY: help demo test lint bench stress fuzz mutations clean install

help:  ## say what there is
	@grep -E '^[a-z]+:.*##' Makefile | sed -E 's/^([a-z]+):[^#]*## */  make \1\t/' | expand -t 18

$(VENV)/bin/python:
	@command -v $(PYTHON) >/dev/null || { echo "error: no '$(PYTHON)' found; install Python 3.11 or newer, or: make PYTHON=/path/to/python" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "error: $$($(PYTHON) --version) is too old; Python 3.11 or newer is needed: make PYTHON=python3.12" >&2; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "error: $(PYTHON) could not make an environment; on Debian and Ubuntu: apt install python3-venv" >&2; exit 2; }

# One stamp per set of extras, so that the demo does not wait for test tools.
$(VENV)/installed: pyproject.toml | $(VENV)/bin/python
	$(RUN) -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/bin/python
	$(RUN) -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@ $(VENV)/installed

install: $(VENV)/installed-dev  ## make the environment with all tools

demo: $(VENV)/installed  ## render the built-in scene hundred_lights to out/
	@mkdir -p out
	$(RUN) -m warp_deferred render hundred_lights -o out/hundred_lights.png --plan $(ARGS)

test: $(VENV)/installed-dev  ## run the tests
	$(RUN) -m pytest -n auto $(ARGS)

lint: $(VENV)/installed-dev  ## check style and format
	$(RUN) -m ruff check $(SOURCES)
	$(RUN) -m ruff format --check $(SOURCES)

stress: $(VENV)/installed-dev  ## run the property tests with thousands of draws
	$(RUN) -m pytest --hypothesis-profile=stress tests/test_properties.py tests/kernels/test_encoding.py $(ARGS)

fuzz: $(VENV)/installed-dev  ## damage model files and load them under caps: make fuzz ARGS="--seconds 600"
	$(RUN) -m tests.fuzz $(ARGS)

mutations: $(VENV)/installed-dev  ## break a line for each hard case, and see that its test notices
	$(RUN) -m tests.mutations $(ARGS)

bench: $(VENV)/installed-dev  ## list the benches, or run one: make bench ARGS="frame --device cuda:0"
	$(RUN) -m bench $(or $(ARGS),--help)

clean:  ## remove the environment, outputs and caches of this folder
	rm -rf $(VENV) out build *.egg-info .pytest_cache .ruff_cache .hypothesis tests/failures
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +
