# Everything a newcomer needs: `make demo`, `make test`. Outside this folder only the user's caches
# are touched.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Blender's Python package exists for one Python only, and wants an older NumPy, so it gets an
# environment of its own.
BLENDER_PYTHON ?= python3.11
BLENDER := .venv-blender

.PHONY: demo demo-cycles blender test test-all check docs clean

demo: $(VENV)/demo.ok
	$(BIN)/skyproof demo

demo-cycles: $(VENV)/demo.ok $(BLENDER)/blender.ok
	$(BIN)/skyproof demo --cycles

blender: $(BLENDER)/blender.ok

# A file's tests stay in one process: what they share, such as trained detectors, is made once. In
# the order of their folders, long files come first, and no process waits for the other at the end.
PYTEST := $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

test: $(VENV)/test.ok
	$(PYTEST) -m "not slow"

# Also whole runs that are killed or meet a full disk, trainings, and hostile input by the thousand.
test-all: test
	$(PYTEST) -m slow

check: $(VENV)/test.ok
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest tests/test_structure.py

# Warnings are errors: a link that leads nowhere stops it. The site is build/site/index.html.
docs: $(VENV)/docs.ok
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) $(BLENDER) build dist .pytest_cache .mypy_cache .ruff_cache

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("skyproof needs Python 3.11 or newer, found " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

# bpy is GPL-3.0; only the worker that runs inside it, under the same licence, uses it.
$(BLENDER)/blender.ok:
	$(BLENDER_PYTHON) -c 'import sys; sys.exit("Blender 4.5 needs Python 3.11, found " + sys.version.split()[0] + "; give make BLENDER_PYTHON=...") if sys.version_info[:2] != (3, 11) else None'
	$(BLENDER_PYTHON) -m venv $(BLENDER)
	$(BLENDER)/bin/python -m pip install --quiet --upgrade pip
	$(BLENDER)/bin/python -m pip install --quiet 'bpy==4.5.*' 'numpy<2'
	$(BLENDER)/bin/python -c 'import bpy'
	touch $@

$(VENV)/demo.ok: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[yolo]'
	touch $@

$(VENV)/test.ok: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[yolo,test,dev]'
	touch $@

$(VENV)/docs.ok: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@
