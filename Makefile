# The two commands: `make demo` and `make test`. Both make their own .venv; nothing but Python >= 3.10 and make is needed.
PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin
# tests and measurements start many processes: compiled modules are kept, also where Python is told not to
ENVIRON = OMP_WAIT_POLICY=passive PYTHONDONTWRITEBYTECODE=
WORKERS ?= auto
PYTEST  = $(ENVIRON) OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal
# without the CPU kernel (no C++ compiler) plain torch renders, and the exact demo is smaller
SMALLER = $$($(BIN)/python -c 'from threestudio_gaussiandreamer.splatting import available_backends as b; print("--config configs/demo-small.yaml" if b()["cpu"] else "")')

.PHONY: demo demo-exact test test-slow test-all test-farm test-lowest docs stability fuzz long-run ablations bench gpu-check train-toybox toybox-sheet charts measure-charts measure-toybox clean

PROMPT =
MODELS = toybox
# both as they are written, without expansion by make or the shell; an empty prompt is reported
demo: export TEXT = $(value PROMPT)
demo: export FOLDER = $(value MODELS)
demo: $(VENV)/ready-for-models     ## text to 3D with small models, offline, on the CPU; make demo MODELS=folder PROMPT="a man in a green jacket and white pants bows"
	$(BIN)/python -m threestudio_gaussiandreamer.toybox.demo $(if $(filter command,$(origin PROMPT)),"$$TEXT") --models "$$FOLDER"

demo-exact: $(VENV)/ready          ## train the bundled toy from a coarse prior with the exact score, offline, on the CPU
	$(BIN)/python launch.py --config configs/demo.yaml $(SMALLER) --train

test: $(VENV)/ready-for-tests      ## every test that isn't slow, one worker per core
	$(PYTEST) -m "not slow"

test-slow: $(VENV)/ready-for-tests ## kills, fuzzing, emulated kernels and runs that train: docs/testing.md
	$(PYTEST) -m slow

test-all: $(VENV)/ready-for-tests  ## both, as CI runs them
	$(PYTEST)

test-farm: $(VENV)/ready-for-farm  ## the farm's tests on Ray and on an S3 server, which test and test-slow skip where Ray isn't installed
	$(PYTEST) tests/farm

LOWEST = .venv-lowest/bin/python
test-lowest: $(VENV)/ready-for-tests ## the lowest declared version of every dependency but torch: a run of every stage, then the tests that read files
	$(PYTHON) -m venv .venv-lowest
	$(BIN)/python -m tests.lowest mesh > .venv-lowest/requirements.txt
	$(LOWEST) -m pip install --quiet -r .venv-lowest/requirements.txt
	$(LOWEST) -m pip install --quiet --no-deps -e .
	$(ENVIRON) $(LOWEST) launch.py --config smoke.yaml --train
	$(ENVIRON) OMP_NUM_THREADS=1 $(LOWEST) -m pytest -n $(WORKERS) -m "not slow" tests/core tests/launch tests/formats tests/meshes tests/gaussians tests/host

stability: $(VENV)/ready-for-tests          ## every known failure, provoked and measured: reports/stability.md
	$(ENVIRON) $(BIN)/python -m pytest tests/stability --stability-report stability.json; status=$$?; \
	$(BIN)/python -m tests.stability.report stability.json; rm -f stability.json; exit $$status

fuzz: $(VENV)/ready-for-tests               ## damaged files for every reader, extreme Gaussians, random densification; nearly two hours of one core
	$(ENVIRON) OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.robustness.fuzz

long-run: $(VENV)/ready            ## 20,000 steps with 50 random kills, against the undisturbed run; a quarter of an hour
	$(ENVIRON) OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.robustness.long_run

ablations: $(VENV)/ready           ## the paper's ablations as a table, measured against a known truth
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.ablations

bench: $(VENV)/ready-for-tests     ## the rasteriser's speed and memory, beside gsplat's torch functions
	$(ENVIRON) $(BIN)/python -m benchmarks.splatting.bench_splatting

gpu-check: $(VENV)/ready-for-tests ## what needs an NVIDIA GPU: correctness, speed beside gsplat, a training step
	$(ENVIRON) $(BIN)/python -m benchmarks.splatting.gpu_check

docs: $(VENV)/ready-for-tests      ## the generated parts of README, docs/ and reports/: architecture, options, measured tables
	$(BIN)/python -m tools.options
	$(BIN)/python -m tests.architecture
	$(BIN)/python -m benchmarks.tables

TOYBOX = .toybox
train-toybox: $(VENV)/ready-for-models       ## train small models on generated objects, from scratch, and export them to .toybox/models; days on a CPU, resumable
	$(ENVIRON) $(BIN)/python -m threestudio_gaussiandreamer.toybox.train $(TOYBOX)
	$(BIN)/python -m threestudio_gaussiandreamer.toybox.export $(TOYBOX) $(TOYBOX)/models

toybox-sheet: $(VENV)/ready-for-models       ## docs/images/toybox-world.png: 100 objects of the toybox
	$(BIN)/python -m tools.toybox_world docs/images/toybox-world.png

charts: $(VENV)/ready-for-charts   ## docs/charts/*.png from the committed numbers beside them
	$(ENVIRON) $(BIN)/python -m benchmarks.splatting.chart_splatting --from-csv
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.chart_runs
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.chart_needed
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.mesh --objects

# the meshes to measure on: make measure-charts OBJECTS="toy.glb path/to/spot.glb path/to/duck.glb"
OBJECTS = toy.glb

measure-charts: $(VENV)/ready-for-charts     ## repeat the measurements, about two hours a mesh; runs that are in the CSVs are skipped
	$(ENVIRON) $(BIN)/python -m benchmarks.splatting.chart_splatting
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.runs --objects $(OBJECTS)
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.chart_runs
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.mesh --objects $(OBJECTS)

measure-toybox: $(VENV)/ready-for-models     ## text to 3D with the bundled models over their settings; runs that are in the CSV are skipped
	$(ENVIRON) $(BIN)/python -m benchmarks.quality.toybox --seeds 0 1 2 3 4

# installed once; again when what is installed changes
PACKAGE = pyproject.toml setup.py constraints.txt $(wildcard threestudio_gaussiandreamer/splatting/cpu/*.h threestudio_gaussiandreamer/splatting/cpu/*.cpp threestudio_gaussiandreamer/splatting/shared/*.h)
PIP     = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
# in place of pip, which uses one core; modules for other versions of Python can't be compiled. A third
# of the code, of which a few modules are used, is left to the first import.
LATER   = /(tests?|transformers/models|diffusers/pipelines)/
COMPILE = $(BIN)/python -m compileall -qq -j 0 -x '$(LATER)' $(VENV)/lib || true

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("Python >= 3.10 is needed, this is " + sys.version) if sys.version_info < (3, 10) else 0'
	$(PYTHON) -m venv $(VENV)

$(VENV)/ready: requirements.txt $(PACKAGE) | $(BIN)/python
	$(PIP) -r requirements.txt
	$(COMPILE)
	touch $@

$(VENV)/ready-for-tests: requirements-dev.txt $(PACKAGE) | $(BIN)/python
	$(PIP) -r requirements-dev.txt
	$(COMPILE)
	touch $@ $(VENV)/ready

$(VENV)/ready-for-charts: $(VENV)/ready
	$(PIP) -c constraints.txt -e .[charts]
	$(COMPILE)
	touch $@

$(VENV)/ready-for-farm: $(VENV)/ready-for-tests
	$(PIP) -c constraints.txt -e .[cluster,farm-test]
	$(COMPILE)
	touch $@

$(VENV)/ready-for-models: $(VENV)/ready
	$(PIP) -c constraints.txt -e .[diffusion]
	$(COMPILE)
	touch $@

clean:                             ## remove what the others made
	rm -rf $(VENV) build *.egg-info outputs
