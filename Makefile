# Everything that needs a tool runs in .venv, which is made on first use and given what is pinned in requirements/: demo.txt for
# planning and pictures, dev.txt for the rest. `make` alone lists the targets.

CANDIDATES := python3 python3.11 python3.12 python3.13 python3.14 python
IS_NEW_ENOUGH := -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
PYTHON ?= $(firstword $(foreach name,$(CANDIDATES),$(shell $(name) $(IS_NEW_ENOUGH) && echo $(name))))

VENV := .venv
RUN := $(VENV)/bin/python
# Without --no-compile, pip would spend most of its time on modules that nobody imports.
INSTALL := $(RUN) -m pip install --quiet --disable-pip-version-check --no-compile
PLANS := $(VENV)/.plans
READY := $(VENV)/.ready
COMPILED := $(VENV)/.compiled
DEMO := examples/scenes/rotterdam.json
UV := uv==0.13.9
# torch is pinned here and not in dev.txt, which would hold the CUDA libraries of its build for Linux. Where pip would choose
# that build and several gigabytes of CUDA are not wanted: make TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH := torch==2.13.0
TORCH_INDEX ?=

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint bench pictures format lock wheels clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*## ' Makefile | sed -E 's/^([a-z-]+):.*## /make \1\t/' | expand -t 18

$(RUN):
	@test -n "$(PYTHON)" || { echo "flockopt needs Python 3.11 or newer; install it, or set PYTHON=/path/to/python" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(PLANS): requirements/demo.txt pyproject.toml | $(RUN)
	@echo "installing what planning and pictures need in $(VENV) (once; less than a minute)"
	@$(INSTALL) --require-hashes --requirement requirements/demo.txt
	@$(INSTALL) --no-deps --no-build-isolation --editable .
	@touch $(PLANS)

$(READY): requirements/dev.txt $(PLANS)
	@echo "installing what tests, checks and benchmarks need in $(VENV) (once; a minute or two)"
	@$(INSTALL) --require-hashes --requirement requirements/dev.txt
	@$(INSTALL) $(addprefix --extra-index-url ,$(TORCH_INDEX)) $(TORCH)
	@touch $(READY)

$(COMPILED): $(PLANS)
	@echo "compiling for this machine (once; a minute or two)"
	@$(RUN) -m flockopt plan $(DEMO) -o $(VENV)/first.plan.json > /dev/null || test $$? -eq 1
	@touch $(COMPILED)

demo: $(COMPILED)  ## plan real city blocks in Rotterdam: a table here; the plan, a picture and a 3-D page in out/
	@mkdir -p out
	$(RUN) -m flockopt plan $(DEMO) -o out/rotterdam.plan.json \
		--show out/rotterdam.png --show out/rotterdam.html

test: $(READY)  ## run the tests
	@$(RUN) -m flockopt compile
	$(RUN) -m pytest

test-slow: $(READY)  ## run the tests that take longer
	$(RUN) -m pytest -m slow

lint: $(READY)  ## check style, formatting and types
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy

# Benchmarks that fly their plans are left out where PyBullet has no wheel.
flying = @if $(RUN) -c "import pybullet" 2>/dev/null; then echo "$(1)"; $(1); else echo "left out for want of PyBullet: $(1)"; fi

bench: $(READY)  ## run every benchmark on a few small scenes
	$(RUN) -m benchmarks.planning --scenes 1 --seed 0 --sizes 4x8 --out out/bench/planning
	$(call flying,$(RUN) -m benchmarks.execution --scenes 1 --seed 0 --drones 4 --tasks 8 --fleets 4 --out out/bench/execution)
	$(RUN) -m benchmarks.travel --scenes 1 --seed 0 --pairs 100 --most 100 --families forest rooms --out out/bench/travel
	$(RUN) -m benchmarks.optimality_gap --scenes 2 --seed 0 --sizes 4x8 --methods greedy,search-5ms,lp,exact --out out/bench/gap
	$(RUN) -m benchmarks.public_instances --data benchmarks/data/mdovrp-val-50.npz --instances 2 --out out/bench/public
	$(RUN) -m benchmarks.trajectories --scenes 2 --seed 0 --size 3x6 --out out/bench/trajectories
	$(RUN) -m benchmarks.audit --scenes 10 --seed 0 --out out/bench/audit
	$(RUN) -m benchmarks.deadlines --scenes 3 --seed 0 --limits 0.3 1 --interrupts 1 --out out/bench/deadlines
	$(RUN) -m benchmarks.replanning --events 4 --drones 4 --tasks 8 --families forest city --out out/bench/replanning
	$(call flying,$(RUN) -m benchmarks.teacher_ablation --scenes 2 --seed 0 --drones 4 --tasks 8 --families forest city --out out/bench/teacher)
	$(RUN) -m benchmarks.student_ablation --scenes 1 --seed 0 --out out/bench/student
	$(RUN) -m benchmarks.timed_flights --scenes 2 --seed 0 --drones 3 --tasks 6 --out out/bench/timed
	$(RUN) -m benchmarks.scalability --scenes 1 --seed 0 --tasks 8 12 --out out/bench/scalability
	$(call flying,$(RUN) -m benchmarks.pipeline --scenes 2 --seed 0 --drones 4 --tasks 8 --out out/bench/pipeline)

pictures: $(READY) demo  ## draw the pictures of the README and docs anew
	$(RUN) -m flockopt show $(DEMO) out/rotterdam.plan.json -o docs/images/rotterdam.png
	$(RUN) docs/draw_families.py docs/images/families.png
	$(RUN) docs/draw_comparison.py docs/images/comparison.png

format: $(READY)  ## mend what the formatter and the linter can mend
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

# One version of each package for every Python, so that plans and types are the same under all of them.
LOCK := $(RUN) -m uv pip compile --universal --python-version 3.11 --fork-strategy fewest --upgrade --generate-hashes \
	--no-header --no-annotate --no-emit-index-url --no-emit-find-links

lock: $(PLANS)  ## pin the newest versions that pyproject.toml allows in requirements/
	$(INSTALL) $(UV)
	echo "torch ; python_version < '3'" | $(LOCK) --override - --output-file requirements/dev.txt pyproject.toml --group dev \
		--extra show --extra solvers --extra trajectory --extra learned --extra openvino --extra sim --extra live --extra peers
	$(LOCK) --constraint requirements/dev.txt --output-file requirements/demo.txt pyproject.toml --group build --extra show

wheels: $(PLANS)  ## ask the index whether every platform and Python gets all that is pinned as wheels
	$(INSTALL) $(UV)
	$(RUN) .ci/wheels.py $(TORCH)

clean:  ## remove what the other targets made
	rm -rf $(VENV) out build dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
