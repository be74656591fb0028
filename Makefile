# make demo       hides an effect in a simulated recording, finds it, adds it, reports it, in demo/
# make test       checks style and runs every test but the long ones
# make test-long  runs the long ones, half an hour: diagnoses, browsers, how often intervals hold
# make bench-hidden  counts false alarms, intervals that hold, effects found by name; CASES=4 of each kind
# make docs       builds the site of docs/ in build/docs
# make clean      removes what these made
#
# With LOCKED=1 they install the versions in requirements.lock, each held to its hash, and no others.
# make lock       makes that file anew; with UPGRADE=1, of the newest versions there are
# make audit      looks up known vulnerabilities of these versions; fails where it cannot
# make licences   writes docs/licences.md from what is installed
# make dist       builds the sdist and, from it, the wheel, in dist/
# make dist-check installs both outside the checkout, and runs the quick tests there

PYTHON = $(firstword $(foreach p,python3.11 python3,$(shell $(p) -c \
	'import sys; (3, 11) <= sys.version_info < (3, 15) and print("$(p)")' 2>/dev/null)))
LIBRARIES = libusb-1.0-0 libgl1 libgomp1 libx11-6
BIN = .venv/bin
OPEN3D_LOADS = $(BIN)/python -c 'import sys; sys.tracebacklimit = 0; import open3d'
# What is used is compiled when it is first imported; to compile all of it takes 14 s more of CPU.
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
# What tests of a file share is made once; files stay in the order that tests/conftest.py gives them.
PYTEST = $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

define PYTHON_NEEDED
@$(if $(PYTHON),,echo "rigcal needs Python 3.11 to 3.14, and neither python3.11 nor python3 is one." >&2; exit 1)
endef

BROWSER = $(firstword $(foreach b,chromium chromium-browser google-chrome,$(shell command -v $(b))))

# What builds and looks up, apart from what rigcal needs.
TOOLS = build/tools
ifdef LOCKED
INSTALLED = .venv/.locked
TESTED = .venv/.locked
else
INSTALLED = .venv/.installed
TESTED = .venv/.tested
endif

# Python keeps what it compiles here, whatever the user has set: each worker of pytest, and each
# program that tests start, would compile all of rigcal anew (4 s).
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-long bench-hidden docs system browser clean lock audit licences dist dist-check

demo: system
	@echo "== demo: a simulated recording of the default rig, with an effect hidden in it"
	rm -rf demo
	$(BIN)/rigcal simulate default -o demo/recording --seed 1 --hide incidence_angle_bias=1
	@echo "== demo: what the recording holds, and what can be estimated from it"
	$(BIN)/rigcal check demo/recording
	@echo "== demo: the joint calibration"
	$(BIN)/rigcal fit demo/recording -o demo/run
	@echo "== demo: what the model lacks"
	$(BIN)/rigcal diagnose demo/run
	@echo "== demo: the same with what was found, and whether that is all"
	$(BIN)/rigcal add demo/run incidence_angle_bias -o demo/grown
	$(BIN)/rigcal diagnose demo/grown
	$(BIN)/rigcal compare demo/run demo/grown
	@echo "== demo: the result for other programs, in demo/export"
	$(BIN)/rigcal export demo/grown -o demo/export
	@echo "== demo: the result for people"
	$(BIN)/rigcal report demo/grown -o demo/report.html
	@echo "== demo: what was found"
	@$(BIN)/python -c 'import calib; print(calib.Run.open("demo/run").diagnosis()["sentences"][0])'
	@echo "The report is demo/report.html; $(BIN)/rigcal view demo/grown opens the workbench."

test: system browser $(TESTED)
	@echo "== test: style"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@echo "== test: pytest"
	$(PYTEST)

test-long: system browser $(TESTED)
	@echo "== test-long: pytest"
	$(PYTEST) -m long

CASES = 4
bench-hidden: system $(TESTED)
	@mkdir -p build
	@echo "== bench-hidden: nothing is hidden, in worlds of a simulator of their own"
	$(BIN)/python -m tests.bench.chance --count $(CASES) -o build/chance.jsonl
	@echo "== bench-hidden: effects, pairs and what no catalogue has"
	$(BIN)/python -m tests.bench.hidden_effects --cases $(CASES) -o build/hidden_effects.jsonl
	@echo "== bench-hidden: formulas that nobody has named"
	$(BIN)/python -m tests.bench.formulas --count $(CASES) --nulls $(CASES) -o build/formulas.jsonl

docs: system
	@echo "== docs: the site, in build/docs"
	$(PIP) sphinx myst-nb furo ipykernel pandas
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs

clean:
	@echo "== clean: removing the environment, the demo and what the tools left"
	rm -rf .venv demo build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -rf {} +

system: .venv/.system

lock: $(TOOLS)/.installed
	@echo "== lock: versions and hashes, for every Python and system, in requirements.lock"
	$(TOOLS)/bin/uv pip compile pyproject.toml --extra test --universal --python-version 3.11 \
		--generate-hashes --quiet $(if $(UPGRADE),--upgrade) \
		--custom-compile-command "make lock" --output-file requirements.lock

audit: $(TOOLS)/.installed
	@echo "== audit: known vulnerabilities of what requirements.lock has"
	$(TOOLS)/bin/pip-audit --strict --require-hashes --disable-pip -r requirements.lock

licences: $(TESTED)
	@echo "== licences: of all that requirements.lock has, in docs/licences.md"
	$(BIN)/python .ci/licences.py requirements.lock docs/licences.md

dist: $(TOOLS)/.installed
	@echo "== dist: the sdist, and from it the wheel"
	rm -rf dist
	$(TOOLS)/bin/python -m build --quiet --outdir dist .

dist-check: dist $(TESTED)
	@echo "== dist-check: both installed outside the checkout, and tested there"
	$(BIN)/python .ci/dist_check.py dist

$(TOOLS)/.installed:
	$(PYTHON_NEEDED)
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install --quiet --disable-pip-version-check build pip-audit uv
	@touch $@

.venv/.installed: pyproject.toml
	$(PYTHON_NEEDED)
	@echo "== install: rigcal and what it needs, into .venv (about 1.2 GB, minutes the first time)"
	$(PYTHON) -m venv .venv
	$(PIP) --editable '.[view]'
	@touch $@

.venv/.tested: .venv/.installed
	@echo "== install: what the tests need"
	$(PIP) --editable '.[test]'
	@touch $@

.venv/.locked: pyproject.toml requirements.lock
	$(PYTHON_NEEDED)
	@echo "== install: rigcal, and the very versions of requirements.lock, into .venv"
	$(PYTHON) -m venv .venv
	$(PIP) --require-hashes -r requirements.lock
	$(PIP) --no-deps --no-build-isolation --editable .
	@touch .venv/.installed .venv/.tested $@

.venv/.system: $(INSTALLED)
	@echo "== system: does Open3D find its system libraries?"
	@if $(OPEN3D_LOADS); then \
		echo "yes"; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "no: installing them with apt-get"; \
		apt-get update && apt-get install -y --no-install-recommends $(LIBRARIES) && $(OPEN3D_LOADS); \
	else \
		echo "no: on Debian or Ubuntu, type this and run make again" >&2; \
		echo "    sudo apt-get install -y --no-install-recommends $(LIBRARIES)" >&2; \
		exit 1; \
	fi
	@touch $@

browser:
	@echo "== browser: is there a Chromium for the tests of pages?"
	@if [ -n "$(BROWSER)" ]; then \
		echo "yes: $(BROWSER)"; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "no: installing it with apt-get"; \
		apt-get update && apt-get install -y --no-install-recommends chromium \
			|| echo "that failed: the tests of pages will be skipped" >&2; \
	else \
		echo "no: the tests of pages will be skipped; on Debian: sudo apt-get install chromium" >&2; \
	fi
