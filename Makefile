# make fly: install, fly the default scenario, say where the report lies.  make test: install, lint, contracts, tests.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
SCENARIO ?= circle

.PHONY: fly test test-page install lint clean

fly: install
	@$(BIN)/mavquad fly $(SCENARIO)

install: $(STAMP)
	@$(BIN)/python -m tools.warm

$(STAMP): requirements.txt pyproject.toml
	@echo "installing into .venv (once; a few minutes)"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.txt
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "not slow"

test-page: install  # the report in a real browser: Debian's package chromium
	$(BIN)/python -m pytest tests/tools/test_report.py -m slow

clean:
	rm -rf .venv build *.egg-info
