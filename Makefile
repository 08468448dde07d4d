# Two commands do all the set-up: `make demo` and `make test`.

PYTHON ?= python3
VENV ?= .venv
OUT ?= out
STAMP := $(VENV)/.installed
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.PHONY: demo test lint setup clean

demo: $(STAMP)
	@mkdir -p $(OUT)
	$(VENV)/bin/drake-oa run tabletop_box --html $(OUT)/tabletop_box.html \
	  --json $(OUT)/tabletop_box.json --log $(OUT)/tabletop_box.npz
	@echo "recording: $(OUT)/tabletop_box.html (open it in a browser)"

test: $(STAMP)
	$(VENV)/bin/python -m pytest

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

setup: $(STAMP)

# open3d loads libusb-1.0 when it is imported.
$(STAMP): pyproject.toml
	@ldconfig -p | grep -q libusb-1.0.so.0 || \
	  { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && \
	    apt-get update -qq && apt-get install -y -qq libusb-1.0-0; } || \
	  { echo "missing system library: install libusb-1.0-0 (Debian: sudo apt-get install libusb-1.0-0)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install -q --upgrade pip
	$(VENV)/bin/pip install -q -e '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) $(OUT) build dist *.egg-info
