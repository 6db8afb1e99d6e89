# make demo   real capture -> dataset -> report        make test   everything CI runs
# make studio synthetic capture with known truth       make lint   the checks without tests
SHELL := /bin/bash
PYTHON ?= python3
VENV ?= .venv
CORES ?= 2
BIN := $(abspath $(VENV))/bin
RUN := PATH="$(BIN):$$PATH"

.PHONY: env demo studio test lint bench bench-field bench-gpu bench-scale numerics chaos rulegraph

env: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; \
	  sys.exit(0 if (3, 11) <= v <= (3, 13) else \
	  f"ntop needs Python 3.11, 3.12 or 3.13, found {v[0]}.{v[1]}; run: make env PYTHON=python3.11")'
	@$(PYTHON) -m venv $(VENV) || { echo "ntop: cannot make a virtual environment; \
	  on Debian: apt install python3-venv"; exit 1; }
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --quiet --constraint constraints.txt --editable '.[dev,slurm]'
	@touch $@

demo: env
	@$(RUN) workflow/run.sh demo $(CORES)

studio: env
	@$(RUN) workflow/run.sh studio $(CORES) --configfile config/studio.yaml

test: env lint
	$(RUN) python -m pytest -n $(CORES)

lint: env
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) snakefmt --check Snakefile workflow
	$(RUN) lint-imports
	$(RUN) snakemake --lint

# a campaign's life at four sizes, hours on two cores; goes on where it was stopped
SCALE_FOLDER ?= benchmarks/work/scale
bench-scale: env
	$(RUN) python -m benchmarks.scale run $(SCALE_FOLDER) 1k tar
	$(RUN) python -m benchmarks.scale run $(SCALE_FOLDER) 1k files
	$(RUN) python -m benchmarks.scale run $(SCALE_FOLDER) 10k tar
	$(RUN) python -m benchmarks.scale run $(SCALE_FOLDER) 10k files
	$(RUN) python -m benchmarks.scale run $(SCALE_FOLDER) 100k tar
	$(RUN) python -m benchmarks.scale run $(SCALE_FOLDER) short tar
	$(RUN) python -m benchmarks.scale run $(SCALE_FOLDER) 570k tar
	$(RUN) python -m benchmarks.scale record $(SCALE_FOLDER)

# the acceptance suite for arithmetic, with its measured margins written into docs/numerics.md
numerics: env
	$(RUN) python -m pytest tests/numerics -n $(CORES) -o junit_family=xunit1 --junitxml=$(VENV)/numerics.xml
	$(RUN) python scripts/write_numerics_page.py $(VENV)/numerics.xml

# disturb the tiny campaign many times; the table of trials is docs/chaos.md (an hour or two)
TRIALS ?= 60
SEED ?= 7
chaos: env
	$(RUN) python -m tests.chaos --trials $(TRIALS) --seed $(SEED) --jobs $(CORES)

# time against error of the renderer and what skipping saves; reads a finished demo if there is one
bench: env
	$(RUN) python -m benchmarks.quadrature
	$(RUN) python -m benchmarks.skipping
	$(RUN) python -m benchmarks.throughput
	$(RUN) python scripts/write_benchmarks_page.py

# quality over training time, grid and twin; what a capture's errors cost; what the error consists of;
# hours on an idle machine, BENCH=--quick is a smoke test
bench-field: env
	$(RUN) NUMBA_NUM_THREADS=$(CORES) python -m benchmarks.field $(BENCH)
	$(RUN) NUMBA_NUM_THREADS=$(CORES) python -m benchmarks.robustness $(BENCH)
	$(RUN) NUMBA_NUM_THREADS=$(CORES) python -m benchmarks.budget $(BENCH)
	$(RUN) NUMBA_NUM_THREADS=$(CORES) python -m benchmarks.poses
	$(RUN) NUMBA_NUM_THREADS=$(CORES) python -m benchmarks.heldout
	$(RUN) python scripts/write_field_page.py

# training and rendering on an NVIDIA GPU, a few minutes; PARTS="launches views" for some parts only
bench-gpu: env
	@command -v nvidia-smi > /dev/null || { echo "ntop: bench-gpu needs an NVIDIA GPU and its \
	  driver, and this machine has no nvidia-smi"; exit 1; }
	@$(BIN)/python -c 'import numba_cuda' 2> /dev/null || \
	  $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[cuda]'
	$(RUN) python -m benchmarks.gpu $(PARTS)

rulegraph: env
	$(RUN) scripts/draw_rulegraph.sh
