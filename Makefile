# make setup   a virtual environment in .venv with everything
# make demo    stream a procedural room through all services and open the report (SEQUENCE=path for your own)
# make test    format, lint, types, import contracts, tests

PYTHON ?= python3
BIN := .venv/bin
SEQUENCE ?= demo/room
OUT ?= demo/run

.PHONY: setup demo test check clean

setup: .venv/.ready

.venv/.ready: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, found " + sys.version.split()[0])'
	@$(PYTHON) -m venv .venv || { echo "no virtual environment could be made; on Debian: apt-get install python3-venv"; exit 1; }
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet -c requirements.lock -e '.[dev,mesh]'
	@$(BIN)/python -c 'import open3d' 2>/dev/null || echo "note: mesh export alone needs system libraries: apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1"
	@touch $@

# The calibration is written last: a room that was broken off is made again.
demo/room/calibration.json: | .venv/.ready
	$(BIN)/pointslam synth demo/room --frames 120 --noise kinect

demo: .venv/.ready $(if $(filter demo/room,$(SEQUENCE)),demo/room/calibration.json)
	$(BIN)/pointslam run $(SEQUENCE) --out $(OUT)
	@echo "report: $(OUT)/report.html   views: $(OUT)/renders/"

check: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# A file's tests stay in one process: they share the services that it starts.
test: check
	$(BIN)/pytest --numprocesses 2 --dist loadfile

clean:
	rm -rf .venv demo
