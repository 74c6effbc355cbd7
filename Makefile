.PHONY: demo test test-slow robots bench clean

VENV := .venv
PYTHON := $(VENV)/bin/python
PYTEST := $(PYTHON) -m pytest -n auto --maxprocesses 4 --dist loadfile

# One stamp per environment: pip runs again only when pyproject.toml changed.
$(VENV)/ready: pyproject.toml
	test -x $(PYTHON) || python3 -m venv $(VENV)
	$(PYTHON) -m pip install --quiet --disable-pip-version-check --editable ".[test]"
	touch $@

demo: $(VENV)/ready
	$(VENV)/bin/drake-pose demo

# Without the tests that are marked slow, which `make test-slow` runs: together they are all tests.
test: $(VENV)/ready
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy
	$(PYTEST) -m "not slow"

test-slow: $(VENV)/ready
	$(PYTEST) -m slow

# Other people's robots for the tests, which are skipped without: 1.3 GB.
robots: $(VENV)/ready
	$(PYTHON) -m pip install --quiet --disable-pip-version-check --editable ".[robots]"

bench: $(VENV)/ready
	$(PYTHON) -m drake_pose.apps.benchmark
	$(PYTHON) -m drake_pose.apps.cluster_benchmark

clean:
	rm -rf $(VENV) results
