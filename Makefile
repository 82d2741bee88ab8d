# Two commands do everything on a fresh machine: `make control` and `make test`. The first use of either builds .venv.

PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.ready
PIP := $(PY) -m pip --disable-pip-version-check install --progress-bar on

NOTEBOOKS := quickstart collect train predict latent control robustness action_prior claims your_own explore pusht

.PHONY: help $(NOTEBOOKS) test reliability bench explorer docs lint lock release clean

help:
	@echo "make control   plan with the shipped models and execute the plans: notebooks/05_control.ipynb"
	@echo "make quickstart, collect, train, predict, latent, robustness, action_prior, claims, your_own, explore, pusht"
	@echo "               the other notebooks, into runs/laptop/seed0/"
	@echo "make test      all tests, among them every notebook, cut down"
	@echo "make reliability   kills and damaged files, at full length"
	@echo "make bench     speed against references, and docs/speed.md"
	@echo "make explorer  the page for the browser, into explorer/dist (needs node and npm)"
	@echo "make docs      the notebooks where they are not executed yet, and the documentation, into docs/_build/html"
	@echo "make lint      style, types, and import contracts"
	@echo "make release   everything of a release, into dist/ (RELEASING.md)"
	@echo "make lock      versions and hashes: uv.lock and environment.lock"
	@echo "make clean     remove .venv and caches; runs/ stays"

$(NOTEBOOKS): $(READY)
	$(PY) -m tsmlib run $@

test: $(READY)
	$(PY) -m tsmlib test

reliability: $(READY)
	$(PY) tests/reliability $(PARTS)

bench: $(READY)
	$(PY) benchmarks/speed.py

explorer: $(READY)
	@command -v npm >/dev/null || { echo "the explorer is built with node and npm, of which npm is missing: install node 20 or newer" >&2; exit 1; }
	cd explorer && npm ci --ignore-scripts --no-audit --no-fund
	$(PY) explorer/export.py explorer/dist
	node explorer/build.mjs

# Notebooks are shown as runs/laptop/seed0 executed them, which is done first where it is missing (15 minutes at its first
# use), or as another run did: make docs RUN=runs/paper/seed0
docs: $(READY)
	$(if $(RUN),,OMP_NUM_THREADS=1 $(PY) -m tsmlib run all --missing)
	TSM_DOCS_RUN=$(RUN) OMP_NUM_THREADS=1 $(PY) -m sphinx -b html -n -W --keep-going docs docs/_build/html

lint: $(READY)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(VENV)/bin/lint-imports

release: $(READY)
	$(PY) release.py check $(ARGS)
	$(MAKE) explorer docs
	$(PY) release.py $(ARGS)

# Needs uv (pip install uv). Versions stay where they can; new ones: make lock ARGS=--upgrade. torch.lock is written by hand.
lock:
	uv lock $(ARGS)
	grep '^#' environment.lock > lock.tmp
	uv export -q --frozen --no-annotate --no-header --no-emit-project --prune torch --all-groups \
		--extra study --extra minari --extra tensorboard | \
		sed -e "s/ and ((platform_machine.*'win32'))//" -e "s/python_full_version < '3.15' and //" \
		-e "s/ ; python_full_version < '3.15' / /" >> lock.tmp
	mv lock.tmp environment.lock

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -not -path './runs/*' -prune -exec rm -rf {} +

# torch goes first and by itself, so that a CPU build of it is kept where one is found.
$(READY): torch.lock environment.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "tsmlib needs Python 3.11 or newer, found `$(PYTHON) --version 2>&1`. Name another: make PYTHON=python3.12" >&2; exit 1; }
	@echo "Building $(VENV) from environment.lock, once. To fetch: about 500 MB, and some 3 GB more where the package index"
	@echo "has torch for CUDA; 1.7 GB on disk without that. Two to ten minutes, most of it the network's and the disk's."
	@echo "pip says what it fetches, how large that is and how far it has come."
	$(PYTHON) -m venv $(VENV)
	@echo "1 of 3: torch, the largest part"
	@$(PIP) -r torch.lock
	@echo "2 of 3: everything else"
	@$(PIP) --require-hashes -r environment.lock
	@echo "3 of 3: tsmlib itself"
	@$(PIP) -q --no-deps --no-build-isolation -e .
	@touch $@
	@echo "$(VENV) is ready."
