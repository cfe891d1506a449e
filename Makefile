# `make fly` flies the hover experiment, `make test` runs every test; both set up .venv by themselves.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin

.PHONY: fly test bench clean

fly: .venv/fly.stamp
	$(BIN)/floaty fly hover

test: .venv/test.stamp
	$(BIN)/python -m pytest -n auto

bench: .venv/test.stamp
	$(BIN)/python tools/bench.py

.venv/pip.stamp:
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	@touch $@

.venv/fly.stamp: .venv/pip.stamp pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[radio,view]'
	@touch $@

.venv/test.stamp: .venv/fly.stamp
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@touch $@

clean:
	rm -rf .venv runs
