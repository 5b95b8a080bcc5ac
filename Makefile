# make notebook: run the notebooks end to end.  make test: lint, types, tests and notebooks.  make docs: the site.
# make test-lowest: the fast tests with the lowest versions that pyproject.toml allows, and on newer Pythons.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin

.PHONY: notebook test test-lowest lint format docs docs-serve clean

# $(call install,PYTHON,ENVIRONMENT,CONSTRAINTS,EXTRA)
define install
$(1) -m venv $(2)
$(2)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(3) --editable ".[$(4)]"
touch $(2)/installed
endef

notebook: .venv/installed
	$(BIN)/python notebooks/render.py

# Each file has its own process, two at a time, the largest first, since what XLA has compiled stays in a process's memory.
# The tests in a browser are skipped where there is none; `make docs` is what can require it.
test: lint
	(echo notebooks; ls -S tests/test_*.py) | REQUIRE_BROWSER= xargs -n 1 -P 2 $(BIN)/python -m pytest --quiet

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: .venv/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The pages, in site/; any warning is an error. Where there is a Chromium (REQUIRE_BROWSER=1: there must be one), it opens them all.
docs: .venv/docs-installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python docs/check.py
	$(BIN)/python -m pytest --quiet -m "not slow" tests/test_watch_it_learn.py

docs-serve: .venv/docs-installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs serve

.venv/docs-installed: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[docs]"
	touch $@

.venv/installed: pyproject.toml constraints.txt
	$(call install,$(PYTHON),.venv,constraints.txt,dev)

# Newer Pythons, where they are installed.
NEWER := $(shell for version in 3.12 3.13; do python$$version -c "" 2>/dev/null && echo $$version; done)

.PRECIOUS: .venv-%/installed

test-lowest: $(addprefix test-on-,lowest $(NEWER))

test-on-%: .venv-%/installed
	.venv-$*/bin/python -m pytest -m "not slow" --numprocesses 2 --dist loadfile tests

.venv-lowest/installed: pyproject.toml constraints-lowest.txt
	$(call install,$(PYTHON),.venv-lowest,constraints-lowest.txt,test)

.venv-%/installed: pyproject.toml constraints.txt
	$(call install,python$*,.venv-$*,constraints.txt,test)

clean:
	rm -rf .venv .venv-* build site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
