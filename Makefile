# Two commands do everything on a fresh machine: `make control` and `make test`. The first use of either builds .venv.

PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.ready
TEST := OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder  # two processes of one thread

.PHONY: help collect train predict latent control robustness action_prior claims test reliability bench lint clean

help:
	@echo "make control   plan with the shipped models and execute the plans: notebooks/05_control.ipynb into runs/"
	@echo "make collect   collect data      (notebooks/01_collect.ipynb)"
	@echo "make train     train the models  (notebooks/02_train.ipynb)"
	@echo "make predict   score predictions (notebooks/03_predict.ipynb)"
	@echo "make latent    use and meaning of latent codes (notebooks/04_latent.ipynb)"
	@echo "make robustness   noisy sensors and delayed actions (notebooks/06_robustness.ipynb)"
	@echo "make action_prior   plans with and without the action prior (notebooks/07_action_prior.ipynb)"
	@echo "make claims    verdicts on the paper's claims from the results that ship (notebooks/08_claims.ipynb)"
	@echo "make test      all tests, then all notebooks cut down"
	@echo "make reliability   the reliability checks at full length, and docs/reliability.md (an hour of one CPU)"
	@echo "make bench     speed of everything against references, and docs/speed.md"
	@echo "make lint      style, types, and import contracts"
	@echo "make clean     remove .venv and caches; runs/ stays"

collect train predict latent control robustness action_prior claims: $(READY)
	$(PY) -m tsmlib run $@

test: $(READY)
	$(TEST) tests
	$(TEST) --nbval-lax notebooks

reliability: $(READY)
	$(PY) tests/reliability $(PARTS)

bench: $(READY)
	$(PY) -m tsmlib bench
	$(PY) -m tsmlib bench table

lint: $(READY)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(VENV)/bin/lint-imports

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -not -path './runs/*' -prune -exec rm -rf {} +

# torch goes first and by itself, so that a CPU build of it is kept where one is found.
$(READY): environment.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "tsmlib needs Python 3.11 or newer, found `$(PYTHON) --version 2>&1`. Name another: make PYTHON=python3.12" >&2; exit 1; }
	@echo "Building $(VENV) from environment.lock: about a minute, once."
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install -qq `grep '^torch==' environment.lock`
	$(PY) -m pip install -qq -r environment.lock
	$(PY) -m pip install -qq --no-deps --no-build-isolation -e .
	@touch $@
