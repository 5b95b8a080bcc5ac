# make notebook: run the notebooks end to end.  make lab: work in them, in JupyterLab.  make test: everything that is checked.
# make coverage: the share of lines that the tests run.  make docs: the site.
# make test-lowest: the fast tests with the lowest versions that pyproject.toml allows, and on newer Pythons.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALL := -m pip install --no-compile --disable-pip-version-check
PIP := $(BIN)/python $(INSTALL) --constraint constraints.txt

# Modules are compiled when they are first imported, not when they are installed. Python must keep what it compiles.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: notebook lab test test-lowest coverage lint format docs docs-serve clean

# Each of these files says that .venv holds one extra of the package.
notebook: .venv/has-notebooks
	$(BIN)/python notebooks/render.py
	@echo
	@echo "Done. Open notebooks/deep_q_network.ipynb in your editor with the kernel of .venv, or type: make lab"

lab: .venv/has-explore
	cd notebooks && ../$(BIN)/jupyter lab

.venv/has-notebooks: pyproject.toml constraints.txt
	@echo "Installing the package and TensorFlow into .venv: 0.7 GB to download, 2.5 GB on disk, some minutes."
	$(PYTHON) -m venv .venv
	$(PIP) --editable ".[notebooks]"
	@touch $@

.venv/has-%: .venv/has-notebooks
	@echo "Installing what \"$*\" needs into .venv."
	$(PIP) --quiet --editable ".[$*]"
	@touch $@

# Two processes at a time, what takes longest first. A process has three files, since TensorFlow takes seconds to start, but
# what XLA has compiled stays in its memory.
# They share what XLA has compiled on disk (nothing does if the path has a space).
# The tests in a browser are skipped where there is none; `make docs` is what can require it.
LONG := $(addprefix tests/test_, docs.py keras_parts.py)

test: lint
	(echo notebooks; echo $(LONG); echo $(filter-out $(LONG), $(shell ls -S tests/test_*.py)) | xargs -n 3) | \
	DQN_KERAS_CACHE="$(CURDIR)/.venv/xla" REQUIRE_BROWSER= xargs -L 1 -P 2 $(BIN)/python -m pytest --quiet

# Every line of the package that a test runs, and those that none does.
coverage: .venv/has-dev
	rm -f .coverage*
	$(BIN)/coverage run -m pytest --quiet -m "not slow" tests
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report

# Outside of a git repository, the checks that need no list of its files.
lint: .venv/has-dev
	if git rev-parse --git-dir > /dev/null 2>&1; then $(BIN)/pre-commit run --all-files; \
	else $(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy; fi

format: .venv/has-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The pages, in site/; any warning is an error. Where there is a Chromium, it opens them all; with REQUIRE_BROWSER=1 there must
# be one, and it also plays "Watch it learn", as `make test` does where there is one.
docs: .venv/has-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python docs/check.py
	$(if $(REQUIRE_BROWSER),$(BIN)/python -m pytest --quiet -m "not slow" tests/test_watch_it_learn.py)

docs-serve: .venv/has-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs serve

# Newer Pythons, where they are installed.
NEWER := $(shell for version in 3.12 3.13; do python$$version -c "" 2>/dev/null && echo $$version; done)

.PRECIOUS: .venv-%/has-test

test-lowest: $(addprefix test-on-,lowest $(NEWER))

TESTS := tests

test-on-%: .venv-%/has-test
	.venv-$*/bin/python -m pytest -m "not slow" --numprocesses 2 --dist loadfile $(TESTS)

.venv-lowest/has-test: pyproject.toml constraints-lowest.txt
	$(call install,$(PYTHON),.venv-lowest,constraints-lowest.txt)

.venv-newest/has-test: pyproject.toml
	$(call install,$(PYTHON),.venv-newest,/dev/null)

.venv-%/has-test: pyproject.toml constraints.txt
	$(call install,python$*,.venv-$*,constraints.txt)

# $(call install,PYTHON,ENVIRONMENT,CONSTRAINTS)
define install
$(1) -m venv $(2)
$(2)/bin/python $(INSTALL) --quiet --constraint $(3) --editable ".[test]"
@touch $(2)/has-test
endef

clean:
	rm -rf .venv .venv-* build dist site *.egg-info .coverage .pytest_cache .mypy_cache .ruff_cache .hypothesis
