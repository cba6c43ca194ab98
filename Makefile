# `make run` and `make test` need only make and Python 3.11 or newer: they set up .venv, from the lock, by themselves.

PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13 python3.14; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin
ARGS ?=

.PHONY: help setup run test slow nightly smoke docs format lock clean
.DEFAULT_GOAL := help

help:
	@echo 'make run     set up if needed, then replay the recording that ships with the project (ARGS=... adds options)'
	@echo 'make test    set up if needed, then lint, format check, types and the default tests'
	@echo 'make slow    the statistical tests of minutes'
	@echo 'make nightly more of them, of the rivals and of the tests themselves'
	@echo 'make smoke   build the wheel, install it into an empty environment, and use it there'
	@echo 'make docs    build the documentation into site/'
	@echo 'make format  sort imports and format every file'
	@echo 'make lock    write requirements.lock again (ARGS=--upgrade moves every version)'
	@echo 'make setup   only set up'
	@echo 'make clean   remove .venv and all caches'

run: setup
	$(BIN)/farside replay $(ARGS)

test: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2 --dist loadfile $(ARGS)

# pytest answers 5 where no test is marked slow.
slow: setup
	$(BIN)/pytest -m slow -n 2 --dist loadfile --durations=25 $(ARGS) || [ $$? -eq 5 ]

nightly: setup
	$(BIN)/pytest -m nightly -n 2 --dist loadfile $(ARGS)

smoke: setup
	.ci/smoke

# Material's banner about a later mkdocs would be taken for a warning by readers.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Versions already locked stay unless pyproject.toml or ARGS says otherwise.
lock: setup
	$(BIN)/uv pip compile pyproject.toml --extra dev --python-version 3.11 --universal --fork-strategy fewest \
		--generate-hashes --custom-compile-command 'make lock' --quiet --output-file requirements.lock $(ARGS)

clean:
	rm -rf .venv site probnerf/kernel/*.so .jax_cache .hypothesis .mypy_cache .pytest_cache .ruff_cache *.egg-info

setup: .venv/.installed .venv/.kernel

# The stamps are written last, so a set-up that was cut short is taken up again.
.venv/.locked: requirements.lock
	@[ -n "$(PYTHON)" ] || { echo 'farside needs Python 3.11 or newer on PATH; found none.' \
		'Install it, or name it: make PYTHON=/path/to/python3.11' >&2; exit 1; }
	@echo 'Setting up .venv from requirements.lock: 1.5 GB, a minute or a few'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --require-hashes --requirement requirements.lock
	@touch $@

# Editable; setuptools would warn of that on every new machine.
.venv/.installed: .venv/.locked pyproject.toml
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# Without a C++ compiler this only says so: the kernel is never needed, it is several times faster.
.venv/.kernel: .venv/.installed $(wildcard probnerf/kernel/*.cc probnerf/kernel/*.h) probnerf/kernel/build.py
	$(BIN)/python -m probnerf.kernel.build
	@touch $@
