.PHONY: demo test test-slow robots docs bench figures clean

VENV := .venv
PYTHON := $(VENV)/bin/python
PYTEST := $(PYTHON) -m pytest -n auto --maxprocesses 4 --dist loadfile

PIP := $(PYTHON) -m pip install --quiet --disable-pip-version-check --no-compile --editable
# pip would compile every module of every package; Python does it for those that are imported.
unexport PYTHONDONTWRITEBYTECODE

# One stamp per set of packages: pip runs again only when pyproject.toml changed.
$(VENV)/ready: pyproject.toml
	test -x $(PYTHON) || python3 -m venv $(VENV)
	$(PIP) .
	touch $@

$(VENV)/ready-%: $(VENV)/ready
	$(PIP) ".[$*]"
	touch $@

demo: $(VENV)/ready
	$(VENV)/bin/drake-pose demo

# Without the tests that are marked slow, which `make test-slow` runs: together they are all tests.
test: $(VENV)/ready-test
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy
	$(PYTEST) -m "not slow"

test-slow: $(VENV)/ready-test
	$(PYTEST) -m slow

# Other people's robots for the tests, which are skipped without: 1.3 GB.
robots: $(VENV)/ready-robots

# All pages and the Python API as web pages: build/docs/index.html. A broken reference is an error.
docs: $(VENV)/ready-docs
	$(PYTHON) -m sphinx -n -W --keep-going -q -d build/docs-cache -c docs . build/docs

# DATA: a folder of recorded scenes; without it only the demonstration's is estimated, and no camera registered.
DATA ?= $(wildcard ../shared/data)
# As the command line has it: threads that wait for each other are not what is measured.
bench: export OPENBLAS_NUM_THREADS = 1
bench: $(VENV)/ready-cluster
	$(PYTHON) -m tests.benchmarks.speed
	$(PYTHON) -m tests.benchmarks.filters
	$(PYTHON) -m tests.benchmarks.seeds
	$(PYTHON) -m tests.benchmarks.silhouette_camera
	$(PYTHON) -m tests.benchmarks.estimates $(DATA)
	$(if $(DATA),$(PYTHON) -m tests.benchmarks.registration $(DATA) --cases 1)
	$(if $(DATA),$(PYTHON) -m tests.benchmarks.episodes $(DATA) --rooms 1 --spoilt --only SO-101)
	$(if $(DATA),$(PYTHON) -m tests.benchmarks.wrists $(DATA) --only textured)
	$(PYTHON) -m tests.benchmarks.memory
	$(PYTHON) -m tests.benchmarks.cluster

# The tables of tutorials/figures.md, about an hour of two cores; NAMES="hands date": these sections.
figures: export OPENBLAS_NUM_THREADS = 1
figures: $(VENV)/ready-cluster
	$(PYTHON) -m tests.benchmarks.figures $(or $(DATA),../shared/data) $(NAMES)

clean:
	rm -rf $(VENV) results build
