# One command each, nothing before it: `make run`, `make test`.
# ARGS=… takes the place of the arguments of a study or measurement: make coverage ARGS="--cables 3".
VENV ?= .venv
BIN := $(VENV)/bin
# Bytecode of what is used comes with its first use: of 10,000 modules few are.
INSTALL := $(if $(shell command -v uv),uv pip install --quiet --python $(BIN)/python,$(BIN)/pip install --quiet --disable-pip-version-check --no-compile)
PYTHON ?= $(firstword $(foreach p,python3.12 python3.11 python3.13 python3,$(shell $(p) -c "import sys; print('$(p)' if (3,11) <= sys.version_info[:2] < (3,14) else '')" 2>/dev/null)))
CYCLES ?= 3

.PHONY: run serve test lint types imports quick compiled compiled-cell compiled-arm compiled-effects compiled-tests tests tests-real-time tests-computing hardware bench figures learn pages coverage practice studies checks benchmark-effects benchmark-rods discover fault-trials handshake calibration-study malformed endurance kills plant insertion clean help jaw-plate picture docs docs-site

help:            ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

run: $(VENV)/.user   ## three simulated cables through the whole cycle
	$(BIN)/cell run --config config/fake.yaml --cycles $(CYCLES) $(ARGS)
	@echo "next: . $(BIN)/activate makes \`cell\` known to this shell; \`cell\` says what to do first"

serve: $(VENV)/.web   ## the pages of a simulated cell at http://127.0.0.1:8080, until Ctrl-C
	@folder=$$(mktemp -d) && sed 's/^world:.*/&\n  real_time_factor: 1.0/' config/fake.yaml > $$folder/cell.yaml \
		&& trap 'kill $$cell 2> /dev/null; wait; rm -rf '$$folder EXIT && trap exit INT TERM \
		&& { $(BIN)/cell run --config $$folder/cell.yaml --cycles forever & cell=$$!; } \
		&& $(BIN)/cell serve --config $$folder/cell.yaml $(ARGS)

# Matrices are small: a second thread of linear algebra only spins.  Modules are compiled once for
# all processes, whatever the shell says of bytecode.
export OPENBLAS_NUM_THREADS = 1
export PYTHONDONTWRITEBYTECODE =

test: $(VENV)/.dev   ## everything that CI checks
	$(MAKE) --no-print-directory -j 2 lint compiled-cell types compiled-arm compiled-effects imports compiled-tests
	$(MAKE) --no-print-directory tests

quick: $(VENV)/.dev   ## before a commit: lint, types, the tests that the change touches; a minute at most
	$(MAKE) --no-print-directory -j 2 lint types
	@files=$$($(BIN)/python -m tools.quick $(ARGS)) && { test -z "$$files" || $(BIN)/pytest -n 2 --budget 40 -m 'not real_time' $$files; }

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell docs README.md CHANGELOG.md CONTRIBUTING.md cell drivers calib tools config

types: $(VENV)/.dev
	$(BIN)/mypy

imports: $(VENV)/.dev
	$(BIN)/lint-imports

compiled: compiled-cell compiled-arm compiled-effects   # machine code on disk, or each test process would compile it

compiled-cell: $(VENV)/.dev
	@folder=$$(mktemp -d) && (cat config/fake.yaml; echo "recording: null") > $$folder/cell.yaml \
		&& $(BIN)/cell run --config $$folder/cell.yaml --cycles 1 --runs $$folder/runs > $$folder/log 2>&1 \
		|| { cat $$folder/log; rm -rf $$folder; exit 1; }; rm -rf $$folder

compiled-arm: $(VENV)/.dev
	@$(BIN)/python -c "from drivers.ur_kinematics import load_code; load_code()"

compiled-effects: $(VENV)/.dev
	@$(BIN)/python -c "from cell.cable.effects import library, unscreened; from cell.cable.effects.compiled import loops_of; [loops_of(e) for e in (library() | unscreened()).values()]"

compiled-tests: $(VENV)/.dev   # to bytecode, once: all processes of the tests begin at the same time
	@$(BIN)/pytest -q --collect-only > /dev/null || true  # what is wrong the tests say themselves

tests: tests-real-time   # nothing computes beside what runs in real time
	$(BIN)/pytest -n 4 --dist worksteal -m 'not real_time' || $(ALONE) -m 'not real_time'  # many tests wait

# A part of its own, for who works on the lab; it takes the processor's spare time.
COMPUTING := tests/cell/lab

# What fails beside other tests runs once more, alone and by name: a slow computer serves only one.
ALONE = $(BIN)/pytest -v --last-failed --last-failed-no-failures none

# A camera, an arm's process or a serial line that is not served for 40 ms is lost.
REAL_TIME := -m real_time tests/end_to_end tests/drivers
tests-real-time: $(VENV)/.dev
	$(BIN)/pytest -n 2 --dist loadfile $(REAL_TIME) || $(ALONE) $(REAL_TIME)

tests-computing: $(VENV)/.dev
	$(BIN)/pytest -n 2 --dist worksteal --spare-time $(COMPUTING)

hardware: $(VENV)/.dev   ## the conformance suite on the devices of CONFIG=file; they move
	@test -n "$(CONFIG)" || { echo "error: say which cell: make hardware CONFIG=config/line3.yaml"; exit 2; }
	$(BIN)/pytest -v -rs --hardware --config $(CONFIG) tests/drivers/conformance $(ARGS)

bench: $(VENV)/.dev   ## speed, as ratios against a peer in one run
	$(BIN)/python -m tools.bench.bench $(ARGS)

figures: $(VENV)/.dev   ## the paper's figures from this code
	$(BIN)/python -m tools.figures.paper_figures $(ARGS)

learn: $(VENV)/.dev   ## an effect hidden in the world is found, promoted, and its cables are inserted
	$(BIN)/python -m tools.studies.learn $(if $(EFFECT),--effect $(EFFECT)) $(ARGS)

jaw-plate: $(VENV)/.dev   ## the drawing of the jaw's plate, to scale
	$(BIN)/python -m tools.figures.jaw_plate $(or $(ARGS),-o docs/images/jaw_plate.pdf --png docs/images/jaw_plate.png)

picture: $(VENV)/.dev   ## the README's picture, of a simulated cycle; DRAW=effect_pictures: of the effects; page_pictures: of the pages
	$(BIN)/python -m tools.figures.$(or $(DRAW),cycle_picture) $(ARGS)

docs-site: $(VENV)/.dev   ## the manual as a site, in cell/manual: for the pages, `cell help --browser`, a wheel
	$(BIN)/python -m tools.site.build $(ARGS)

docs: $(VENV)/.dev   ## run every command of README and docs, the slow ones too
	CELL_DOCS=all $(BIN)/pytest tests/docs

coverage: $(VENV)/.dev   ## do the 95 % intervals cover the truth? 100 filmed cables, ~10 min
	$(BIN)/python -m tools.studies.coverage_study $(or $(ARGS),--pictures)

practice: $(VENV)/.dev   ## every practice study beside its truth
	$(BIN)/python -m tools.studies.diagnosis_study $(or $(ARGS),practice.csv --practice)

studies: $(VENV)/.dev   ## verdicts on 900 studies with a known answer (hours; a stopped one goes on)
	$(BIN)/python -m tools.studies.diagnosis_study $(or $(ARGS),studies.csv --made complete=100 one=100 pair=27 unknown=34 --breadth complete=300 one=200 outside=100 --rigs all=60)

checks: $(VENV)/.dev   ## what each check of the verdict is worth: 411 studies, 40 min
	$(BIN)/python -m tools.studies.diagnosis_study --checks $(or $(ARGS),checks.csv --first 2000 --seed 2 --breadth complete=200 one=100 outside=50 --made pair=27 unknown=34)

benchmark-effects: $(VENV)/.benchmark   ## this lab and its peers on 300 studies (14 CPU hours; a stopped one goes on)
	$(BIN)/python -m tools.studies.benchmark_effects $(or $(ARGS),benchmark --seed 1)

benchmark-rods: $(VENV)/.benchmark   ## simulators of planar rods: CPU time to a stated error (an hour; a stopped one goes on; --small: 2 min)
	$(BIN)/python -m tools.bench.benchmark_rods $(or $(ARGS),benchmark/rods_tried.csv --table benchmark)

discover: $(VENV)/.dev   ## the laws of ten effects outside the library, inferred (20 min)
	$(BIN)/python -m tools.studies.discover_study $(ARGS)

fault-trials: $(VENV)/.dev   ## a fault in every device in every step, and processes killed, ~40 min
	$(BIN)/python -m tools.faults.fault_trials --patience-s 0.15 $(or $(ARGS),-o docs/measured/fault_trials.csv)

handshake: $(VENV)/.dev   ## 50 cycles over Modbus and 50 over the controller's I/O, by a PLC that misbehaves, ~10 min
	$(BIN)/python -m tools.faults.handshake_trial $(ARGS)

calibration-study: $(VENV)/.dev   ## true errors of 20 calibrations beside what they say, and beside OpenCV, ~4 min
	$(BIN)/python -m tools.studies.calibration_study $(or $(ARGS),--setups 20)

malformed: $(VENV)/.dev   ## 1,000 spoilt studies, settings, motions, models and effects
	MALFORMED_CASES=$(or $(CASES),1000) $(BIN)/pytest -n 2 tests/end_to_end/test_malformed.py

endurance: $(VENV)/.dev   ## 500 cycles against the emulators: memory, threads, files (~40 min)
	$(BIN)/python -m tools.faults.endurance $(or $(ARGS),--cycles 500)

insertion: $(VENV)/.dev   ## insertion rate by opening and by what may be chosen; ARGS: worlds, ways (30 min)
	$(BIN)/python -m tools.studies.insertion_study $(or $(ARGS),insertion.csv --cables 200)

plant: $(VENV)/.dev   ## adapters and pages killed in every step of a cycle, ~10 min
	$(BIN)/python -m tools.plant.adapter_kills $(ARGS)

pages: $(VENV)/.dev   ## the pages' memory over the updates of 8 h, ~6 min
	$(BIN)/python -m tools.plant.pages_soak $(ARGS)

kills: $(VENV)/.dev   ## 100 cells killed at random moments: what `cell recover` gives back (~40 min)
	$(BIN)/python -m tools.faults.kill_study $(or $(ARGS),kills.csv)

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "error: Python 3.11 to 3.13 is needed; none found on PATH (set PYTHON=/path/to/python3.11)"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile --upgrade pip || true  # that of Python 3.11 takes twice as long

$(VENV)/.user: pyproject.toml | $(VENV)/bin/python
	$(INSTALL) -e .
	@touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	$(INSTALL) -e ".[dev]"
	@touch $(VENV)/.user $@

$(VENV)/.benchmark: pyproject.toml | $(VENV)/bin/python
	$(INSTALL) -e ".[dev,benchmark]"
	@touch $(VENV)/.user $(VENV)/.dev $@

$(VENV)/.web: pyproject.toml | $(VENV)/bin/python
	$(INSTALL) -e ".[web]"
	@touch $(VENV)/.user $@

clean:           ## remove the environment and caches
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache
