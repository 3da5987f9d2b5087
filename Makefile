# Environments are made by the targets that need them; nothing but Python 3.11, make and a package registry is assumed.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
DEMO := .venv/demo
TEST := .venv/test
PIP := -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo test lint bench clean

demo: $(DEMO)/.done
	$(DEMO)/bin/obsnet demo --out demo-output

test: $(TEST)/.done lint
	$(TEST)/bin/python -m pytest --cov=obsnet --cov-report=term --cov-report=xml

lint: $(TEST)/.done
	$(TEST)/bin/ruff check .
	$(TEST)/bin/ruff format --check .
	$(TEST)/bin/mypy
	$(TEST)/bin/lint-imports

bench: $(TEST)/.done $(DEMO)/.done
	$(TEST)/bin/python tests/bench/bench.py --python $(DEMO)/bin/python

$(DEMO)/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(DEMO)
	$(DEMO)/bin/python $(PIP) -e .
	$(DEMO)/bin/python -m compileall -q obsnet  # pip compiles what it installs, but for what stays in place
	touch $@

$(TEST)/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(TEST)
	$(TEST)/bin/python $(PIP) -e ".[ais,archive,serve,train,bench,dev]"
	touch $@

clean:
	rm -rf .venv demo-output .pytest_cache .ruff_cache .mypy_cache coverage.xml .coverage
