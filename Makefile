# make demo: from nothing to a reconstructed, replayed clip.   make test: from nothing to a tested tree.
# On a machine without a GPU, point TORCH_FROM at a folder or index that has the CPU build of torch
# (`make demo TORCH_FROM="--index-url URL"`, the URL is on PyTorch's installation page); otherwise pip
# takes the build it finds first, which on Linux brings the CUDA libraries along and works without a GPU too.

PYTHON ?= python3
TORCH ?= torch==2.13.0
TORCH_FROM ?=
BIN := .venv/bin
DEMO := demo
WORKERS ?= 2

export MUJOCO_GL ?= egl
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test assets check install lock clean

install: .venv/installed

# torch first and by itself: the lock leaves out torch and its CUDA packages, so that one lock fits
# machines with and without a GPU. Everything else is installed by hash.
.venv/installed: pyproject.toml requirements.lock
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" \
	  || { echo "error: Python 3.11 or newer is needed; set PYTHON=/path/to/python3.11" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet $(TORCH_FROM) "$(TORCH)"
	$(BIN)/python -m pip install --quiet --no-deps --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

demo: install
	$(BIN)/taa doctor --rendering
	$(BIN)/taa synth $(DEMO)/clip --clip demo --seed 0 --overwrite
	$(BIN)/taa reconstruct $(DEMO)/clip/demo/video.mp4 --id demo --out $(DEMO)/assets --scene $(DEMO)/scene --overwrite
	TAA_ASSETS=$(DEMO)/assets $(BIN)/taa replay demo --video $(DEMO)/replay.mp4
	cp $(DEMO)/assets/demo/report.html $(DEMO)/report.html
	@echo "open $(DEMO)/report.html (the report) and $(DEMO)/replay.mp4 (video and replay side by side)"

# Two processes of one thread each: the suite is made of many short simulations and fits. Whole clips take minutes each,
# so a process that is done takes work from the other.
test: install
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --durations 15

# The assets that ship, from clips that are rendered here; under an hour on two cores.
assets: install
	$(BIN)/python -m benchmarks.build_assets --work build/assets

docs: install
	$(BIN)/python -m mkdocs build --strict --quiet
	@echo "open site/index.html"

check: install
	$(BIN)/ruff check .
	$(BIN)/mypy

# Needs uv. The packages left out are torch and what only its CUDA build needs.
LEFT_OUT := torch triton cuda-bindings cuda-pathfinder cuda-toolkit nvidia-cublas nvidia-cuda-cccl \
  nvidia-cuda-cupti nvidia-cuda-nvrtc nvidia-cuda-runtime nvidia-cudnn-cu13 nvidia-cufft nvidia-cufile \
  nvidia-curand nvidia-cusolver nvidia-cusparse nvidia-cusparselt-cu13 nvidia-nccl-cu13 nvidia-nvjitlink \
  nvidia-nvshmem-cu13 nvidia-nvtx
# uv does not look at upper bounds of Requires-Python: backports-strenum 1.3 is for Python 3.10 and older.
lock:
	printf '%s\n' "$(TORCH)" "backports-strenum<1.3" | uv pip compile pyproject.toml --extra dev --constraints - --universal --python-version 3.11 \
	  --generate-hashes --no-emit-index-url --no-annotate --no-header --quiet \
	  $(addprefix --no-emit-package ,$(LEFT_OUT)) --output-file requirements.lock

clean:
	rm -rf .venv $(DEMO) build dist site
