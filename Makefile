# Everything from a clone: `make demo` and `make test`. What is fetched goes into .venv and a cache (~/.cache/upright).
PYTHON ?= python3
VENV = .venv/bin
PARALLEL ?= auto
PYTEST = $(VENV)/python -m pytest -n $(PARALLEL) --no-loadscope-reorder
CHECKED = cpython unix32
space := $() $()
comma := ,

.PHONY: setup demo check test soak lint bench clean

setup:  ## .venv with .venv/bin/upright
	@$(PYTHON) tools/bootstrap.py

demo: setup  ## the firmware on the simulated board
	@$(VENV)/upright demo

check: setup lint  ## what a change most likely breaks, in two minutes: two runtimes, no emulated board
	@$(VENV)/upright runtimes $(CHECKED)
	@$(PYTEST) -q -m "not slow" --runtimes=$(subst $(space),$(comma),$(CHECKED)) $(PYTEST_ARGS)

test: setup lint  ## everything, on every runtime that this machine can have
	@$(PYTHON) tools/bootstrap.py --extras
	@$(VENV)/upright runtimes cpython unix unix-1.26 unix32 arm
	@$(PYTEST) --build-board $(PYTEST_ARGS)

soak: setup  ## hours: the tests marked soak, with a hundred times the inputs and a day of simulated faults
	@$(PYTEST) -m soak --soak --timeout=0 $(PYTEST_ARGS)

lint: setup
	@$(VENV)/ruff check .
	@$(VENV)/ruff format --check .

bench: setup  ## instructions and memory, as ratios measured in one run
	@$(VENV)/upright bench

clean:
	rm -rf .venv tools/*.egg-info .pytest_cache .ruff_cache .hypothesis
