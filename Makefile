# Every target sets up what it needs: a virtual environment in .venv with pinned packages, and the
# compiled module beside the Python sources.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed

.PHONY: help build demo test test-all test-triton test-gpu test-lowest test-isa test-asan fuzz kills mutants lint format bench bench-gpu study study-int8 learned-lens worlds study-dense tables docs dist wheels repair published-wheels test-torch aarch64 clean

help:  ## this list
	@grep -E '^[a-z0-9-]+:.*##' Makefile | sed -E 's/:.*## /\t/' | expand -t 18

$(STAMP): requirements.txt pyproject.toml setup.py
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q -r requirements.txt
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/pip install -q --no-build-isolation --no-deps -e .
	@touch $@

build: $(STAMP)  ## (re)build darswin/libdarswin.so in place
	@PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python setup.py -q build_ext --inplace

demo: build  ## train on nearly undistorted digits, test through any fisheye, draw it (2 minutes)
	$(BIN)/python examples/digits.py

# As many processes as cores, four at most: a process takes more than a gigabyte.
PYTEST := OMP_NUM_THREADS=1 $(CURDIR)/$(BIN)/python -m pytest -n auto --maxprocesses=4 --dist worksteal

test: build  ## the tests that take no time: values, gradients, errors
	$(PYTEST) -m "not slow"

test-all: build  ## all tests: compiled graphs, processes, training and the pages' code too
	$(PYTEST)

# Triton stands in a folder of its own, so that all else is tested without it.
TRITON := .triton
TRITON_VERSION := 3.9.0

$(TRITON)/$(TRITON_VERSION): $(STAMP)
	rm -rf $(TRITON)
	$(BIN)/pip install -q --no-deps --target $(TRITON) triton==$(TRITON_VERSION)
	@touch $@

test-triton: build $(TRITON)/$(TRITON_VERSION)  ## the kernels for GPUs without one: interpreted, and compiled
	TRITON_INTERPRET=1 PYTHONPATH=$(CURDIR)/$(TRITON) $(PYTEST) -q tests/gpu
	PYTHONPATH=$(CURDIR):$(CURDIR)/$(TRITON) $(BIN)/python tests/gpu/compile_kernels.py

# torch's builds for CUDA bring Triton. Without a device the tests say so and are skipped.
test-gpu: build  ## the kernels and models on a CUDA device
	$(BIN)/python -m pytest -q -rs tests/gpu

# Everything that pyproject.toml declares, at its lowest version, but for torch.
LOWEST := .venv-lowest

$(LOWEST)/installed: pyproject.toml requirements.txt tests/lowest.py
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python tests/lowest.py > $(LOWEST)/requirements.txt
	$(LOWEST)/bin/pip install -q --only-binary :all: -r $(LOWEST)/requirements.txt
	@touch $@

test-lowest: build $(LOWEST)/installed  ## the commands, files, pictures and ONNX with the oldest libraries allowed
	PYTHONPATH=$(CURDIR) $(LOWEST)/bin/python -m pytest -q tests/data tests/models/test_saving.py \
	  tests/cli tests/viz \
	  tests/deploy/test_export.py -k "not program and not package"

test-isa: build  ## the operators' tests on every instruction-set tier of this machine
	@set -e; for tier in $$($(BIN)/python -c 'from darswin.ops import _module; print(*_module.tiers())'); do \
	  echo "== $$tier"; \
	  ATEN_CPU_CAPABILITY=$$(echo $$tier | sed s/generic/default/) \
	    $(PYTEST) -q tests/ops \
	      tests/test_build.py::test_the_tier_in_use_is_the_one_asked_for; \
	done

# The sanitized module stands with a copy of the sources in a folder of its own, and the tests run
# from there. Python itself is not sanitized, so the sanitizers' libraries come first.
SANITIZED := build/sanitized
PRELOAD = $(shell g++ -print-file-name=libasan.so):$(shell g++ -print-file-name=libstdc++.so)

test-asan: build  ## the operators' tests on every tier under AddressSanitizer and UBSan
	@rm -rf $(SANITIZED)/darswin
	@PATH=$(CURDIR)/$(BIN):$$PATH DARSWIN_SANITIZE=address,undefined \
	  $(BIN)/python setup.py -q build --build-lib $(SANITIZED)
	@set -e; tiers=$$($(BIN)/python -c 'from darswin.ops import _module; print(*_module.tiers())'); \
	cd $(SANITIZED); for tier in $$tiers; do \
	  echo "== $$tier, sanitized"; \
	  LD_PRELOAD="$(PRELOAD)" ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 \
	  UBSAN_OPTIONS=print_stacktrace=1 ATEN_CPU_CAPABILITY=$$(echo $$tier | sed s/generic/default/) \
	    $(PYTEST) -q -c $(CURDIR)/pyproject.toml --rootdir $(CURDIR) \
	      -m "not unsanitized" $(CURDIR)/tests/ops; \
	done

fuzz: build  ## random and hostile calls of the operators, 100,000 wrong calibrations (40 minutes)
	$(BIN)/python -X faulthandler -m pytest -q --hypothesis-profile=fuzz \
	  tests/ops/test_properties.py tests/ops/test_hostile.py tests/lens/test_mutations.py

kills: build  ## kill runs at random, and see that they end as if nothing had been (10 minutes)
	$(BIN)/python tests/train/kills.py

mutants: build  ## change one thing in the code at a time and count what the tests notice (hours); goes on where it was stopped
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python tests/mutants.py

lint: $(STAMP)  ## ruff, mypy and clang-format, without changing anything
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run --Werror $$(find csrc -name '*.h' -o -name '*.cpp')

format: $(STAMP)  ## ruff and clang-format, in place
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $$(find csrc -name '*.h' -o -name '*.cpp')

bench: build  ## time the operators against their peers, and training; nothing else should be running
	$(BIN)/python benchmarks/sampling.py --out benchmarks/results
	$(BIN)/python benchmarks/attention.py --out benchmarks/results
	$(BIN)/python benchmarks/to_image.py --out benchmarks/results
	$(BIN)/python benchmarks/one_frame.py --out benchmarks/results
	$(BIN)/python benchmarks/training.py --out benchmarks/results
	$(BIN)/python -m darswin bench --out benchmarks/results

bench-gpu: build  ## time the operators and a model on a CUDA device
	$(BIN)/python benchmarks/gpu.py

study: build  ## the paper's experiments, small: an hour; goes on where it was stopped
	$(BIN)/python studies/study.py

study-int8: build  ## what 8 bits cost the study's models: half an hour more; goes on where it was stopped
	$(BIN)/python studies/quantized.py

learned-lens: build  ## find unknown lenses by gradient descent: ten minutes; goes on where it was stopped
	$(BIN)/python studies/learned_lens.py

worlds: build  ## render pictures, labels and distances of a game's worlds: 3 minutes; needs `apt-get install freedoom`
	$(BIN)/python studies/render_worlds.py --out out/worlds

study-dense: build  ## labels and distances through unknown lenses: 3 hours; goes on where it was stopped
	$(BIN)/python studies/dense.py

tables: $(STAMP)  ## fill the tables of README and docs from the results of bench and study
	$(BIN)/python docs/fill.py

docs: build  ## the site of docs/, in build/docs; warnings are errors
	$(BIN)/python -m sphinx -q -n -W --keep-going docs build/docs

dist: $(STAMP)  ## sdist and wheel in dist/
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python -m build --no-isolation --outdir dist

# One wheel of a platform serves every Python. It shares its libraries with torch, which is imported
# first. What is published is made by cibuildwheel, which runs `repair` and tests/installed.py too.
wheels: $(STAMP)  ## the manylinux_2_28 wheel in dist/, tested in a fresh environment
	rm -rf build/wheel
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python -m build --no-isolation --wheel --outdir build/wheel
	PATH=$(CURDIR)/$(BIN):$$PATH $(MAKE) repair WHEEL="$$(echo build/wheel/*.whl)"
	$(MAKE) test-torch

DEST := dist
repair:
	auditwheel repair --plat manylinux_2_28_$$(uname -m) --only-plat --wheel-dir "$(DEST)" \
	  --exclude 'libtorch*' --exclude 'libc10*' --exclude 'libgomp*' "$(WHEEL)"

published-wheels: $(STAMP)  ## the same in the manylinux_2_28 container, by cibuildwheel: needs Docker
	$(BIN)/cibuildwheel --output-dir dist

# The versions of torch that the wheel of `make wheels` is tested under, a fresh environment each.
TORCH := $(shell sed -n 's/^torch==//p' requirements.txt)
SCRATCH := build/scratch

test-torch:  ## the wheel under TORCH="2.10.0 2.11.0 …", on PYTHON; gigabytes of downloads each
	@set -e; for version in $(TORCH); do \
	  echo "== torch $$version on $(PYTHON)"; \
	  $(PYTHON) -m venv --clear $(SCRATCH); \
	  $(SCRATCH)/bin/pip install -q torch==$$version dist/darswin-*-manylinux_2_28_$$(uname -m).whl \
	    $$(grep -E '^(hypothesis|pytest)==' requirements.txt); \
	  $(SCRATCH)/bin/python tests/installed.py; \
	done

# It links against the libraries of torch's wheel for aarch64, unpacked.
aarch64: $(STAMP)  ## cross-compile for aarch64 with g++-aarch64-linux-gnu and TORCH_DIR=…/torch
	PATH=$(CURDIR)/$(BIN):$$PATH; cmake --log-level=NOTICE -S . -B build/cmake-aarch64 -G Ninja \
	  -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
	  -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++ -DTORCH_DIR="$(TORCH_DIR)" \
	  -DDARSWIN_OUTPUT_DIR=$(CURDIR)/build/aarch64 && cmake --build build/cmake-aarch64

clean:  ## remove what was built
	rm -rf build dist darswin.egg-info darswin/libdarswin.so
