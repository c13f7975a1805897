# Everything that needs a tool runs in .venv, which is made on first use from the pinned requirements.lock.
# `make` alone lists the targets.

CANDIDATES := python3 python3.11 python3.12 python3.13 python3.14 python
IS_NEW_ENOUGH := -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
PYTHON ?= $(firstword $(foreach name,$(CANDIDATES),$(shell $(name) $(IS_NEW_ENOUGH) && echo $(name))))

VENV := .venv
RUN := $(VENV)/bin/python
READY := $(VENV)/.ready
COMPILED := $(VENV)/.compiled
DEMO := examples/scenes/rotterdam.json
UV := uv==0.13.9
# torch is pinned here and not in the lock, which would hold the CUDA libraries of its build for Linux. Where pip would choose
# that build and several gigabytes of CUDA are not wanted: make TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH := torch==2.13.0
TORCH_INDEX ?=

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint bench pictures format lock clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*## ' Makefile | sed -E 's/^([a-z-]+):.*## /make \1\t/' | expand -t 18

$(READY): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "flockopt needs Python 3.11 or newer; install it, or set PYTHON=/path/to/python" >&2; exit 1; }
	@echo "setting up $(VENV) (once; a minute or two)"
	@$(PYTHON) -m venv $(VENV)
	@$(RUN) -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements.lock
	@$(RUN) -m pip install --quiet --disable-pip-version-check $(addprefix --extra-index-url ,$(TORCH_INDEX)) $(TORCH)
	@$(RUN) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $(READY)

$(COMPILED): $(READY)
	@echo "compiling for this machine (once; a minute or two)"
	@$(RUN) -m flockopt plan $(DEMO) -o $(VENV)/first.plan.json > /dev/null || test $$? -eq 1
	@touch $(COMPILED)

demo: $(COMPILED)  ## plan real city blocks in Rotterdam: a table here; the plan, a picture and a 3-D page in out/
	@mkdir -p out
	$(RUN) -m flockopt plan $(DEMO) -o out/rotterdam.plan.json \
		--show out/rotterdam.png --show out/rotterdam.html

test: $(READY)  ## run the tests
	$(RUN) -m pytest

test-slow: $(READY)  ## run the tests that take longer
	$(RUN) -m pytest -m slow

lint: $(READY)  ## check style, formatting and types
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy

bench: $(READY)  ## run every benchmark on a few small scenes
	$(RUN) -m benchmarks.planning --scenes 1 --seed 0 --sizes 4x8 --out out/bench/planning
	$(RUN) -m benchmarks.execution --scenes 1 --seed 0 --drones 4 --tasks 8 --fleets 4 --out out/bench/execution
	$(RUN) -m benchmarks.optimality_gap --scenes 2 --seed 0 --sizes 4x8 --methods greedy,search-5ms,lp,exact --out out/bench/gap
	$(RUN) -m benchmarks.public_instances --data benchmarks/data/mdovrp-val-50.npz --instances 2 --out out/bench/public
	$(RUN) -m benchmarks.trajectories --scenes 2 --seed 0 --size 3x6 --out out/bench/trajectories
	$(RUN) -m benchmarks.replanning --events 4 --drones 4 --tasks 8 --families forest city --out out/bench/replanning
	$(RUN) -m benchmarks.teacher_ablation --scenes 2 --seed 0 --drones 4 --tasks 8 --families forest city --out out/bench/teacher
	$(RUN) -m benchmarks.student_ablation --scenes 1 --seed 0 --out out/bench/student
	$(RUN) -m benchmarks.timed_flights --scenes 2 --seed 0 --drones 3 --tasks 6 --out out/bench/timed
	$(RUN) -m benchmarks.scalability --scenes 1 --seed 0 --tasks 8 12 --out out/bench/scalability
	$(RUN) -m benchmarks.pipeline --scenes 2 --seed 0 --drones 4 --tasks 8 --out out/bench/pipeline

pictures: demo  ## draw the pictures of the README and docs anew
	$(RUN) -m flockopt show $(DEMO) out/rotterdam.plan.json -o docs/images/rotterdam.png
	$(RUN) docs/draw_families.py docs/images/families.png
	$(RUN) docs/draw_comparison.py docs/images/comparison.png

format: $(READY)  ## mend what the formatter and the linter can mend
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

lock: $(READY)  ## pin the newest versions that pyproject.toml allows in requirements.lock
	$(RUN) -m pip install --quiet $(UV)
	echo "torch ; python_version < '3'" | $(RUN) -m uv pip compile --override - --universal --python-version 3.11 \
		--generate-hashes --upgrade --no-header --no-annotate --no-emit-index-url --no-emit-find-links \
		--extra show --extra solvers --extra trajectory --extra learned --extra openvino --extra sim --extra live --extra peers \
		--extra dev --output-file requirements.lock pyproject.toml

clean:  ## remove what the other targets made
	rm -rf $(VENV) out build dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
