# From a bare Python 3.11 and a fresh clone: `make demo`, `make test`. The first call makes .venv (minutes, most of it
# the download of torch); later calls find the stamp file and start at once.
#   make test PYTEST_ARGS="-k ply"
#   make test WORKERS=0                          in one process, for a debugger; otherwise one process a core
#   make demo PIP_ARGS="--extra-index-url URL"   another package index, e.g. torch's own with the smaller CPU build
SHELL := /bin/bash
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
PIP_ARGS ?=
PYTEST_ARGS ?=
WORKERS ?= logical
DEMO_ARGS ?= --out runs/demo
JUDGE_ARGS ?=
STAMP := $(VENV)/.installed
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help install demo kernels test test-all mutation lint docs results notebooks wheel clean

help:
	@echo "make demo | test | test-all | mutation | lint | docs | results | wheel | clean"

install: $(STAMP)

# Byte code is made of what a run loads, not of all 17 000 files, also where the shell says no: without it every command
# compiles that again, for a second.
LOADED := cv2 llvmlite numpy onnxruntime yaml
$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no python3.11 or python3 found; install Python 3.11 or newer, or say make PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "make: $(PYTHON) is older than Python 3.11; say make PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --no-compile $(PIP_ARGS) -c constraints.txt -e '.[dev]'
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m compileall -q edgeslam_torch $(addprefix $(VENV)/lib/python*/site-packages/,$(LOADED)) || true
	@touch $@

demo: $(STAMP)
	$(BIN)/edgeslam demo $(DEMO_ARGS)

# One process a core, each with one thread of torch; a file's tests stay together as long as no process is idle. Byte
# code is kept, also where the shell says no: commands that tests start would compile the package each time.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

# Loops are compiled once and cached, before both processes of the tests would compile them at the same time.
COMPILE := import importlib, sys; from edgeslam_torch.compiled import compile_all; \
	[importlib.import_module(path[:-3].replace("/", ".")) for path in sys.argv[1:]]; compile_all()
LOOPS := $(shell grep -rl --include='*.py' 'compiled import compiled' edgeslam_torch)
KERNELS := $(VENV)/.compiled
kernels: $(KERNELS)
$(KERNELS): $(STAMP) $(LOOPS) $(wildcard edgeslam_torch/compiled/*.py)
	@printf '%s\n' $(LOOPS) | sort | xargs -n 3 -P 2 $(BIN)/python -c '$(COMPILE)'
	@touch $@

# The examples in docstrings are tests too.
TESTED := --doctest-modules tests $$(grep -Rl --include='*.py' '>>> ' edgeslam_torch)
test: $(STAMP) $(KERNELS)
	$(PYTEST) $(TESTED) $(PYTEST_ARGS)

# What measures time, or must keep up with a flying drone, comes after the others; a drone leaves most of a core idle.
test-all: $(STAMP) $(KERNELS)
	$(PYTEST) -m "not alone" $(TESTED) $(PYTEST_ARGS)
	$(PYTEST) -n 3 -m alone $$(grep -rl --include='test_*.py' mark.alone tests) $(PYTEST_ARGS)

# mutmut changes the code in one place at a time and runs the tests that come by: what none of them notices is listed with
# its change. By default every tenth change of ten files, against the fast suite; another tenth and other files each week.
#   make mutation MODULES='edgeslam_torch/geometry/*' TESTS=tests/geometry WHICH='*'
WEEK := $(shell date +%G%V)
WHICH ?= *$(lastword $(shell echo $(WEEK) | grep -o .))
TESTS ?= tests
MODULES ?= $(shell find -L edgeslam_torch -name '*.py' -size +1k | sort | shuf --random-source=<(yes $(WEEK)) -n 10)
MUTMUT := $(abspath $(BIN))/python -m mutmut
mutation: export OMP_NUM_THREADS := 1
mutation: $(STAMP)
	rm -rf runs/mutation && mkdir -p runs/mutation
	cp -rL edgeslam_torch tests docs examples *.md *.txt CITATION.cff Makefile pyproject.toml runs/mutation
	set -f; sed -i "s#^only_mutate = .*#only_mutate = [$$(printf '"%s",' $(MODULES))]#; \
		s#^pytest_add_cli_args_test_selection = .*#pytest_add_cli_args_test_selection = [$$(printf '"%s",' $(TESTS))]#" \
		runs/mutation/pyproject.toml
	cd runs/mutation && $(MUTMUT) run '*__mutmut_$(WHICH)' > mutmut.log
	cd runs/mutation && $(MUTMUT) results | sed -n 's/^ *//; s/: \(survived\|no tests\)$$//p' | \
		xargs -r -n 1 $(MUTMUT) show > survivors.txt
	@echo "$$(grep -c "^# " runs/mutation/survivors.txt) survivors: runs/mutation/survivors.txt"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

wheel: $(STAMP)
	rm -rf dist
	$(BIN)/python tests/check_wheel.py dist

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build -q
	@echo "docs: open site/index.html"

# Runs what the documents quote (an hour on two cores; goes on where it was interrupted), and puts it into them.
CHANGES := no-flow whole-pixels no-depth-network flight-off flight-always literal-cycle literal-total near
RECORDINGS := tum_fr1_xyz 7scenes_redkitchen euroc_mh05_a fr3_notexture_a
results: $(STAMP)
	$(BIN)/edgeslam judge --release docs/results/0.3.json --out runs/release $(JUDGE_ARGS)
	$(BIN)/edgeslam ablation --seeds 1 --max-frames 300 --out runs/ablation \
		$(addprefix --row ,$(CHANGES)) $(addprefix --sequence ,$(RECORDINGS))
	cp runs/ablation/ablation.json docs/results
	$(BIN)/python docs/building/results_pages.py

# Runs the notebooks and keeps what they show.
notebooks: $(STAMP)
	cd examples/notebooks && ../../$(BIN)/jupyter execute --inplace *.ipynb

clean:
	rm -rf dist build site runs $(KERNELS) .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
