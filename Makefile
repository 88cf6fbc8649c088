# make fly: install, fly the default scenario by pid and by the best, say where the page lies.  make test: install, lint, contracts, tests.
PYTHON ?= python3
BIN := .venv/bin
CLIENTS := .venv-clients
PEERS := .venv-peers
STAMP := .venv/.installed
SCENARIO ?= gusty

.PHONY: fly test test-page long soak flood mutate install test-clients fuzz lint clean mutate-limits bench

fly: install
	@$(BIN)/mavquad versus $(SCENARIO)

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

test-page: install  # every page in a real browser: Debian's package chromium
	$(BIN)/python -m pytest tests/tools/test_report.py tests/tools/test_replay_page.py tests/tools/test_campaign_report.py -m slow

mutate-limits: install  # each comparison, sign and constant of the last gate changed alone: its tests must notice
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m tests.mutants mavquad.setpoint.limits tests/unit/test_limits_exactly.py tests/unit/test_setpoint.py

long: install  # eighty minutes of vehicle time in lockstep: flat memory, no miss
	$(BIN)/python -m pytest -s tests/loop/test_long_flight.py -m slow

flood: install  # ten seconds of junk at a companion in flight, as fast as one core sends it: it keeps its rate, its memory stays flat
	$(BIN)/python -m pytest -s tests/loop/test_flood.py -m slow

soak: install  # eighty minutes of vehicle time at ten times real time with faults and a listener between (MAVQUAD_SOAK_MINUTES)
	$(BIN)/python -m pytest -s tests/loop/test_soak.py -m slow

test-clients: install $(CLIENTS)/.installed  # MAVSDK, MAVProxy, pymavlink's tools and node-mavlink against the simulated autopilot
	$(BIN)/python -m pytest tests/clients -m slow

$(CLIENTS)/.installed: requirements-clients.txt tests/clients/programs/package-lock.json
	@echo "installing other people's clients into $(CLIENTS) (once)"
	@test -x $(CLIENTS)/bin/python || $(PYTHON) -m venv $(CLIENTS)
	@$(CLIENTS)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r requirements-clients.txt
	@mkdir -p $(CLIENTS)/node && cp tests/clients/programs/package*.json $(CLIENTS)/node
	@if command -v npm > /dev/null; then cd $(CLIENTS)/node && npm ci --silent --ignore-scripts --no-audit --no-fund; \
	 else echo "no npm: node-mavlink is left out"; fi
	@touch $@

BENCH ?=

bench: install $(PEERS)/.installed  # speed beside the peers, which come into an environment of their own; BENCH="bulk --seconds 2" for a part
	@$(BIN)/mavquad bench $(BENCH)

$(PEERS)/.installed: requirements-peers.txt
	@echo "installing the peers of mavquad bench into $(PEERS) (once; 1.5 GB)"
	@test -x $(PEERS)/bin/python || $(PYTHON) -m venv $(PEERS)
	@$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-peers.txt \
	    && touch $@ || echo "they do not install here: mavquad bench says which are missing, the next make bench tries again"

mutate: install  # every sign of the observer turned around, one at a time: the fast tests must notice (an hour of CPU)
	NUMBA_DISABLE_JIT=1 $(BIN)/python tests/observer_signs.py

FUZZ_SHARE ?= 1
FUZZ_GUIDED_S ?= 300

fuzz: install  # 10 million mutated frames, 100 thousand mutated files, then atheris; FUZZ_SHARE=0.01 for a part of it
	$(BIN)/python -m tests.fuzz --share $(FUZZ_SHARE)
	@test -d .venv-fuzz/atheris || $(BIN)/python -m pip install --quiet --disable-pip-version-check --target .venv-fuzz --no-deps \
	    --require-hashes -r requirements-fuzz.txt || echo "atheris does not install here: the seeded mutator alone"
	@if test -d .venv-fuzz/atheris; then \
	    PYTHONPATH=.venv-fuzz $(BIN)/python -m tests.fuzz.guided -max_total_time=$(FUZZ_GUIDED_S) -verbosity=0; fi

clean:
	rm -rf .venv .venv-fuzz $(CLIENTS) $(PEERS) build *.egg-info
