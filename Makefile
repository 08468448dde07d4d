# `make demo` and `make test` each do all their own set-up, in .venv.

PYTHON ?= python3
VENV ?= .venv
OUT ?= out
# Test processes side by side.
JOBS ?= 2
# What runs, and with it what tests, trains and checks.
STAMP := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
# Small matrices: more threads only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.PHONY: demo test slow regression regression-suites lint gallery docs wheel setup clean

demo: $(STAMP)
	@mkdir -p $(OUT)
	$(VENV)/bin/drake-oa run tabletop_box --html $(OUT)/tabletop_box.html \
	  --json $(OUT)/tabletop_box.json --log $(OUT)/tabletop_box.npz
	@echo "recording: $(OUT)/tabletop_box.html (open it in a browser)"
	@echo "next: . $(VENV)/bin/activate && drake-oa play"

test: $(DEV)
	$(VENV)/bin/python -m pytest -n $(JOBS) --dist worksteal

# Golden logs, runs with faults, moving obstacles or hardware in lockstep, the installed wheel.
slow: $(DEV)
	$(VENV)/bin/python -m pytest -n $(JOBS) --dist worksteal -m slow

# The avoiding motion against stored results; an interrupted check continues where it was.
regression: $(DEV)
	$(VENV)/bin/python -m pytest -n $(JOBS) --dist worksteal -m "" tests/diagrams/test_golden.py tests/regression
	$(VENV)/bin/python -m tests.regression scenarios --jobs $(JOBS)

# The same for random scenes, MotionBenchMaker problems, and the paper's tables.
regression-suites: $(DEV)
	$(VENV)/bin/python -m tests.regression suites --jobs $(JOBS)

lint: $(DEV)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/python -m tests.language
	@rm -rf build/lint && mkdir -p build/lint/drake_oa
	@ln -s $(CURDIR)/drake_oa/* $(CURDIR)/diagrams $(CURDIR)/models build/lint/drake_oa
	cd build/lint && PYTHONPATH=. $(abspath $(VENV))/bin/lint-imports --config $(CURDIR)/pyproject.toml
	cd build/lint && MYPYPATH=. $(abspath $(VENV))/bin/mypy --config-file $(CURDIR)/pyproject.toml -p drake_oa

# Animations of the shipped scenarios in docs/results/recordings; NAMES="a b" records only these.
gallery: $(DEV)
	PYTHONPATH=. $(VENV)/bin/python docs/record_gallery.py $(NAMES)

# The site, in docs/_build/index.html.
docs: $(DEV)
	$(VENV)/bin/sphinx-build -q -W --keep-going -b html docs docs/_build

# A wheel for this version of Python and this architecture, with its kernels compiled: those that
# these commands use. `x86-64-v3` is the processor that the package chooses itself where it can.
DIST ?= $(CURDIR)/dist
# Copy of the source in which kernels are compiled.
WHEEL ?= $(CURDIR)/build/wheel
COMPILED := "run tabletop_box" "run moving_obstacle --duration 3" "run paper_irregular --duration 2" \
  "run demonstrated_pour --duration 1" "run bookshelf --duration 1" "run free_space --duration 1"
wheel: $(DEV)
	rm -rf $(WHEEL) && mkdir -p $(WHEEL)
	cp -r drake_oa diagrams models pyproject.toml README.md LICENSE $(WHEEL)
	find $(WHEEL) -name '*.nb[ic]' -delete
	ln -s ../diagrams ../models $(WHEEL)/drake_oa
	cd $(WHEEL) && for command in $(COMPILED); do \
	  $(abspath $(VENV))/bin/python -m drake_oa.app.main $$command --no-log || exit 1; done
	cd $(WHEEL) && $(abspath $(VENV))/bin/python -m build --wheel --no-isolation --outdir $(DIST) \
	  $$($(abspath $(VENV))/bin/python -c 'import sys, sysconfig; print(*( \
	  f"-C--build-option={o}" for o in (f"--python-tag=cp{sys.version_info[0]}{sys.version_info[1]}", \
	  f"--plat-name={sysconfig.get_platform()}")))')

setup: $(DEV)

# Shared libraries that wheels load: glib and EGL for drake, libusb for open3d.
LIBRARIES := libglib-2.0.so.0:libglib2.0-0 libEGL.so.1:libegl1 libusb-1.0.so.0:libusb-1.0-0

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; name one: make PYTHON=python3.12"; exit 1; }
	@for pair in $(LIBRARIES); do \
	  library=$${pair%%:*}; package=$${pair##*:}; \
	  $(PYTHON) -c "import ctypes; ctypes.CDLL('$$library')" 2>/dev/null && continue; \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && apt-get install -y -qq --no-install-recommends $$package && continue; \
	  fi; \
	  echo "missing $$library: on Debian or Ubuntu, sudo apt-get install $$package"; \
	done
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install -q --disable-pip-version-check -e .
	@touch $@

$(DEV): $(STAMP)
	$(VENV)/bin/python -m pip install -q --disable-pip-version-check -e '.[dev,franka-simulator]'
	@touch $@

clean:
	rm -rf $(VENV) $(OUT) build dist docs/_build docs/api docs/gallery.md docs/jupyter_execute *.egg-info
