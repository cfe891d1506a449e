# `make fly` flies the hover experiment, `make test` runs the tests that need no wall clock, `make test-all` the real-time, client
# and long ones as well, `make check` compares the C and the machine code with the Python that flies; all set up .venv by themselves.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
unexport PYTHONDONTWRITEBYTECODE  # the tests start many programs: each would compile all sources anew

.PHONY: fly test test-all approve check bench mutants docs pictures dist clients clean

fly: .venv/fly.stamp
	$(BIN)/floaty fly hover

test: .venv/test.stamp
	$(BIN)/python -m pytest -n auto

# Real-time tests mostly wait: three run side by side. One that fails is repeated alone and listed as RERUN: repair what appears there.
test-all: .venv/test.stamp
	$(BIN)/python -m pytest -n auto --dist worksteal -m 'not realtime' --durations 20
	$(BIN)/python -m pytest -n 3 --dist loadfile -m realtime --reruns 2 -rsREf --durations 20

# The outputs of tests/approved as they are now: read what git shows of them, and commit what was meant.
approve: .venv/test.stamp
	for test in outputs kernels translations services emulator parts world servers stations research policies experiments wire numbers; do PYTHONPATH=tests $(BIN)/python tests/approved/test_$$test.py || exit; done
	git diff --stat tests/approved

check: .venv/test.stamp
	$(BIN)/floaty deploy check

# Real ground tools for the tests of the serial line. MAVProxy runs headless without what it depends on (1 GB).
clients: .venv/test.stamp
	$(BIN)/python -m pip install --quiet --editable '.[clients]'
	$(BIN)/python -m pip install --quiet --no-deps 'MAVProxy>=1.8.75'

# The documentation as a site: site/index.html. Both variables silence advertisements of the makers.
docs: .venv/docs.stamp
	NO_MKDOCS_2_WARNING=1 DISABLE_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --strict --quiet

# The documentation's pictures anew, with chromium; one alone: make pictures ONLY=report.png
pictures: .venv/docs.stamp
	$(BIN)/python tools/pictures.py $(ONLY)

# Small mistakes, planted one at a time, that no test catches: make mutants ROOM=hil/world [SAMPLE=20]. It takes hours.
mutants: .venv/test.stamp
	$(BIN)/python tools/mutants.py $(ROOM) --sample $(or $(SAMPLE),0)

bench: .venv/test.stamp
	$(BIN)/python tools/bench.py

# A wheel of pure Python for any machine, and the sdist from which it was built.
dist: .venv/test.stamp
	$(BIN)/python -m build --no-isolation

.venv/pip.stamp:
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	@touch $@

.venv/fly.stamp: .venv/pip.stamp pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[radio,mavlink,view,identify,design]'
	@{ command -v gcc || command -v clang || command -v cc; } > /dev/null || $(BIN)/python -m pip install --quiet --editable '.[compiler]'
	@touch $@

.venv/test.stamp: .venv/fly.stamp
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@touch $@

.venv/docs.stamp: .venv/fly.stamp
	$(BIN)/python -m pip install --quiet --editable '.[docs,export]'
	@touch $@

clean:
	rm -rf .venv runs dist site
