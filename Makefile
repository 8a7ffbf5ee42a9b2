# Every target does the set-up that it needs; `make help` lists them.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup demo test assets docs lint wheel release clean

PYTHON := .venv/bin/python
METAGCTTT := .venv/bin/metagcttt
ARGS ?=
WORKERS ?= 2

# Where the machine's own ROS 2 is sourced, the workspace built on it has to be sourced too.
ifneq ($(ROS_DISTRO),)
RUN := source ros2_ws/install/local_setup.bash &&
endif
# Only the pytest plugins named here are loaded: some that come with ROS break recent pytest.
PYTEST := PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 $(PYTHON) -m pytest -p xdist -p pytest_timeout

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: ## create .venv with pinned packages and build the ROS workspace
	@tools/setup.sh

demo: setup ## drive the real maze over ROS: three policies, five goals, a table and a picture
	@$(RUN) $(METAGCTTT) demo $(ARGS)

test: setup ## run all tests; ARGS='-k filter' passes options to pytest
	@$(RUN) $(PYTEST) -n $(WORKERS) --dist worksteal $(ARGS)

PRESET := --preset pointmaze-medium-navigate-cpu
assets: setup ## train the demo's policies from scratch and pack assets/; going on where it ended
	@$(METAGCTTT) generate $(PRESET) --resume
	@$(METAGCTTT) pretrain $(PRESET) --resume
	@$(METAGCTTT) meta-train $(PRESET) --resume
	@$(METAGCTTT) pack-assets $(PRESET)

lint: setup ## check style, formatting and types
	@$(PYTHON) -m ruff check .
	@$(PYTHON) -m ruff format --check .
	@$(PYTHON) -m mypy

wheel: setup ## build the wheel and try it in a fresh environment
	@tools/check_wheel.sh

docs: setup ## build the documentation site; warnings and broken links are errors
	@.venv/bin/sphinx-build -q -W --keep-going -b html -c docs . docs/_build
	@$(PYTHON) tools/check_site.py docs/_build
	@echo docs/_build/docs/index.html

release: wheel ## build what is uploaded, sdist and wheel, and check their descriptions
	@.venv/bin/pip install -q -c constraints.txt -e '.[release]'
	@rm -rf dist && $(PYTHON) -m build --no-isolation --outdir dist
	@$(PYTHON) -m twine check --strict dist/*

clean: ## remove .venv, the built workspace and caches; data/ and out/ stay
	@rm -rf .venv .setup.lock ros2_ws/build ros2_ws/install ros2_ws/log build dist docs/_build \
		*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
