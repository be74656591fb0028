# make demo       simulates a recording, calibrates it, exports and reports the result, in demo/
# make test       checks style and runs every test but the long ones
# make test-long  runs the long ones: how often intervals hold, what else is found by its name
# make clean      removes what these made

PYTHON = $(firstword $(foreach p,python3.11 python3,$(shell $(p) -c \
	'import sys; (3, 11) <= sys.version_info < (3, 15) and print("$(p)")' 2>/dev/null)))
LIBRARIES = libusb-1.0-0 libgl1 libgomp1 libx11-6
BIN = .venv/bin
OPEN3D_LOADS = $(BIN)/python -c 'import sys; sys.tracebacklimit = 0; import open3d'
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check
# What tests of a file share is made once; files stay in the order that tests/conftest.py gives them.
PYTEST = $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

BROWSER = $(firstword $(foreach b,chromium chromium-browser google-chrome,$(shell command -v $(b))))

.PHONY: demo test test-long system browser clean

demo: system
	@echo "== demo: a simulated recording of the default rig"
	rm -rf demo
	$(BIN)/rigcal simulate default -o demo/recording --seed 1
	@echo "== demo: what the recording holds, and what can be estimated from it"
	$(BIN)/rigcal check demo/recording
	@echo "== demo: the joint calibration"
	$(BIN)/rigcal fit demo/recording -o demo/run
	$(BIN)/rigcal compare demo/run
	@echo "== demo: the result for other programs, in demo/export"
	$(BIN)/rigcal export demo/run -o demo/export
	@echo "== demo: the result for people; open demo/report.html, or type $(BIN)/rigcal view demo/run"
	$(BIN)/rigcal report demo/run -o demo/report.html

test: system browser .venv/.tested
	@echo "== test: style"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@echo "== test: pytest"
	$(PYTEST)

test-long: system browser .venv/.tested
	@echo "== test-long: pytest"
	$(PYTEST) -m long

clean:
	@echo "== clean: removing the environment, the demo and what the tools left"
	rm -rf .venv demo build *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -rf {} +

system: .venv/.system

.venv/.installed: pyproject.toml
	@$(if $(PYTHON),,echo "rigcal needs Python 3.11 to 3.14, and neither python3.11 nor python3 is one." >&2; exit 1)
	@echo "== install: rigcal and what it needs, into .venv (about 1.2 GB, minutes the first time)"
	$(PYTHON) -m venv .venv
	$(PIP) --editable '.[view]'
	@touch $@

.venv/.tested: .venv/.installed
	@echo "== install: what the tests need"
	$(PIP) --editable '.[test]'
	@touch $@

.venv/.system: .venv/.installed
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
