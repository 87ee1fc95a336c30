# make demo    train a small pair of networks, retarget a clip, evaluate: minutes on two cores
# make test    run the tests
# make lint    what CI asks of the code's form
# make docs    the documentation, to open in a browser: runs/docs/index.html
# make gallery one clip on everyone, and by every method, as a page: runs/gallery.html
# make bench   the measurements behind our claims, as JSON in runs/bench
# make setup   only the environment, in .venv; the others do this first, once

# The first Python that is new enough; name another with `make PYTHON=/path/to/python3.12 setup`.
PYTHON ?= $(shell for each in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	"$$each" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$$each" && break; done)
# More for pip, e.g. `make PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu" setup`: PyTorch without CUDA.
PIP_FLAGS ?=
# More for pytest, e.g. `make ARGS="-m nightly" test`.
ARGS ?=
# Where the demo goes.
RUN ?= runs/demo

BIN := .venv/bin
READY := .venv/ready

.PHONY: setup demo test lint docs gallery bench
.DELETE_ON_ERROR:

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@if [ -z "$(PYTHON)" ]; then \
		echo "Reenact needs Python 3.11 or newer, and none was found; install one, or name it: make PYTHON=/path/to/python3" >&2; \
		exit 1; fi
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "Reenact needs Python 3.11 or newer, $(PYTHON) is $$("$(PYTHON)" --version 2>&1); name another: make PYTHON=/path/to/python3" >&2; \
		exit 1; }
	@test -x $(BIN)/python || "$(PYTHON)" -m venv .venv
	@echo "Installing what pyproject.toml asks for into .venv; the first time this downloads PyTorch"
	@# Both variables: the second is what newer versions of pip read for the build itself.
	@PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) --editable ".[dev]"
	@touch $@

# Each step of the demo makes a file, and is skipped once the file is there: a finished run is not trained again, a
# stopped one goes on. To start over, remove the folder.
demo: $(RUN)/trained $(RUN)/speech.glb $(RUN)/speech.csv $(RUN)/report.html
	@echo
	@echo "Report      $(RUN)/report.html"
	@echo "Animation   $(RUN)/speech.glb (opens in any glTF viewer), $(RUN)/speech.csv"
	@echo "Numbers     $(RUN)/evaluation/metrics.json"
	@echo "Previews    $(RUN)/previews"

$(RUN)/trained: | $(READY)
	@if [ -e "$(RUN)/config.toml" ]; then $(BIN)/python train.py --run "$(RUN)" --resume; \
		else $(BIN)/python train.py --config configs/demo.toml --run "$(RUN)"; fi
	@touch $@

# Twelve seconds of speech and emotion that the training has not seen.
$(RUN)/speech.glb $(RUN)/speech.csv: $(RUN)/trained
	@$(BIN)/python infer.py "$(RUN)" synthetic:2026:12 --out "$@"

$(RUN)/report.html: $(RUN)/trained
	@$(BIN)/python evaluate.py "$(RUN)"

# The Khronos validator of glTF, where npm is; without it its tests are skipped.
test: $(READY)
	@if command -v npm >/dev/null && [ ! -d .venv/node_modules/gltf-validator ]; then \
		npm install --silent --no-save --no-audit --no-fund --prefix .venv gltf-validator@2.0.0-dev.3.10 || true; fi
	@# One process per core, one thread each; each begins with its half, and takes from the other's end.
	@OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist worksteal $(ARGS)

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

docs: $(READY)
	@$(BIN)/python docs/config_page.py
	@$(BIN)/python -m sphinx -b html -q -W --keep-going -d runs/docs/.cache docs runs/docs
	@echo "Documentation   runs/docs/index.html"

# With the networks of the demo where they are trained.
gallery: $(READY)
	@$(BIN)/python figures/gallery.py $(if $(wildcard $(RUN)/trained),"$(RUN)")

bench: $(READY)
	@mkdir -p runs/bench
	@$(BIN)/python benchmarks/renderer.py --json runs/bench/renderer.json
