# Everything a user or a developer types. Paths are relative, so a folder whose name has spaces works.
PYTHON ?= python3

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
REPLACED := $(VENV:/=)-replaced
# Where pip.conf says `user = true`, pip refuses an environment otherwise.
PIP := install --no-user --quiet --disable-pip-version-check
QUICK := -q -n 2 -m "not slow" --ignore tests/repository
PACKAGES := cdpr calibration executor simulation planner drivers tracking model
COMPILE_REST := from executor.kernels import ready_to_measure, ready_to_simulate; ready_to_measure(); ready_to_simulate()

# The theme of the documentation advertises another program in each build.
export NO_MKDOCS_2_WARNING := 1

# A sourced ROS or Conda shell puts its own packages in front of ours.
unexport PYTHONPATH PYTHONHOME
# Without byte code on disk every process compiles all of it again, and the tests start many.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install demo docs-run wheel test test-root test-quiet test-lowest test-python check-arm64 mutation fuzz hil hil-runs hil-table hil-makers hil-epos4 hil-nanotec-c5e hil-akd hil-subset lint docs schema clean distclean

help:  ## Show this help
	@echo "cdpr: plan, prove, run and measure paths of cable-driven parallel robots"
	@echo
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' Makefile
	@echo
	@echo "The Python to build on: make PYTHON=python3.12 ... (3.11 or newer; now: $(PYTHON))"

# Nothing is installed while the stamp agrees with the pins, the Python and the folder (console scripts hold its
# absolute path), so everything works without a network after the first time. An installation for another Python or
# folder, or whose Python is gone, is kept aside until the new one is complete, and put back where that one fails.
install:  ## Create .venv and install everything into it, pinned (once)
	@place="$$("$(PYTHON)" -V 2>&1) in $$(pwd -P)"; \
	pins="$$(cat pyproject.toml constraints.txt | cksum)"; \
	stamp="$$(cat "$(STAMP)" 2>/dev/null)"; \
	if [ "$$stamp" = "$$place, $$pins" ] && [ -x "$(BIN)/python" ]; then exit 0; fi; \
	case "$$(pwd -P)" in *[\"\`\$$]*) \
	  echo 'The installed programs do not work in a folder whose path contains $$, ` or ".' >&2; \
	  echo "Next: rename the folder; spaces and umlauts are fine" >&2; exit 1 ;; esac; \
	"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "cdpr needs Python 3.11 or newer; $(PYTHON) is $$("$(PYTHON)" -V 2>/dev/null || echo 'not there')." >&2; \
	  echo "Next: install one and name it, for example: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }; \
	"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "$(PYTHON) has no venv module. Next, on Debian or Ubuntu: sudo apt-get install python3-venv" >&2; exit 1; }; \
	echo "Installing into $(VENV) (once; needs the network) ..."; \
	if [ -z "$$stamp" ]; then \
	  if [ -e "$(VENV)" ] && [ "$$("$(BIN)/python" -V 2>&1)" != "$$("$(PYTHON)" -V 2>&1)" ]; then \
	    echo "$(VENV) is not one of these installations, and not of this Python. Next: remove it, or name another:" \
	      "make VENV=.venv-cdpr $(MAKECMDGOALS)" >&2; exit 1; fi; \
	elif [ "$${stamp%, *}" != "$$place" ] || [ ! -x "$(BIN)/python" ]; then \
	  if [ -e "$(REPLACED)/installed" ]; then rm -rf "$(VENV)"; \
	  else rm -rf "$(REPLACED)" && mv "$(VENV)" "$(REPLACED)"; fi || exit 1; fi; \
	put_back() { \
	  if [ -e "$(REPLACED)/installed" ]; then \
	    rm -rf "$(VENV)" && mv "$(REPLACED)" "$(VENV)" && \
	    echo "The installation failed; what was in $(VENV) is there again. Next: repeat it with a network" >&2; fi; }; \
	trap put_back EXIT; \
	trap 'exit 1' HUP INT TERM; \
	"$(PYTHON)" -m venv "$(VENV)" && \
	echo "$$place, unfinished" > "$(STAMP)" && \
	"$(BIN)/python" -m pip $(PIP) --only-binary :all: -c constraints.txt hatchling && \
	"$(BIN)/python" -m pip $(PIP) --only-binary :all: --no-build-isolation -c constraints.txt -e ".[dev]" && \
	"$(BIN)/python" -m pip check --disable-pip-version-check && \
	echo "Compiling the planner, the tags' edge finder and the simulated platform (once; a minute or two) ..." && \
	{ "$(BIN)/python" -c '$(COMPILE_REST)' & rest=$$!; } && \
	"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/environment_1.yaml -o "$(VENV)/first-plan.json" --force --json >/dev/null && \
	wait $$rest && \
	echo "$$place, $$pins" > "$(STAMP)" && \
	trap - EXIT && rm -rf "$(REPLACED)"

demo: install  ## Plan, prove, run and report the paper's first environment on simulated drives
	"$(BIN)/cdpr" demo

# Kernels that the installation did not run, or that changed since, are compiled first, by one process each, and the
# tests' own modules by one: the tests' own processes would compile them several times.
test: install  ## Run the whole test suite on two cores
	@"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/environment_1.yaml --planner adaptive \
	  -o "$(VENV)/paper-plan.json" --force --json >/dev/null & paper=$$!; \
	"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/environment_1.yaml \
	  -o "$(VENV)/first-plan.json" --force --json >/dev/null && \
	"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/turn.yaml --free-rotation --rounds 1 \
	  -o "$(VENV)/turning-plan.json" --force --json >/dev/null && \
	"$(BIN)/python" -c '$(COMPILE_REST)' && \
	"$(BIN)/python" -m pytest --collect-only -q >/dev/null; \
	wait $$paper
	"$(BIN)/python" -m pytest -n 5 --dist loadfile --no-loadscope-reorder

mutation: install  ## Try small changes of the code that keeps people safe (PATHS=executor/safety, or CHANGED=BASE)
	"$(BIN)/python" tools/mutation/run.py $(if $(CHANGED),--changed "$(CHANGED)") $(PATHS)

test-quiet: install  ## Run the tests in real time at 100 Hz, on a computer that does nothing else (real-time rights help)
	"$(BIN)/python" -m pytest -q -m quiet

test-root: install  ## Run the tests that act for two users, which only root may
	"$(BIN)/python" -m pytest -q -m root

# Only what must be installed is pinned to its lowest version; the rest is the newest that goes with it. So what an old
# library does that a newer one under it deprecates is no failure.
test-lowest:  ## Run the quick tests in .venv-lowest, with the lowest version of every dependency (TESTS=tests/model)
	"$(PYTHON)" -m venv --clear .venv-lowest
	"$(PYTHON)" tools/lowest.py > .venv-lowest/constraints.txt
	.venv-lowest/bin/python -m pip $(PIP) --only-binary :all: -c .venv-lowest/constraints.txt hatchling
	.venv-lowest/bin/python -m pip $(PIP) --only-binary :all: --no-build-isolation -c .venv-lowest/constraints.txt -e ".[dev]"
	.venv-lowest/bin/python -m pip check --disable-pip-version-check
	.venv-lowest/bin/python -m pytest $(QUICK) -W ignore::DeprecationWarning $(TESTS)

test-python:  ## Run the quick tests in .venv-python, with another Python (PYTHON=python3.13 TESTS=tests/model)
	"$(PYTHON)" -m venv --clear .venv-python
	.venv-python/bin/python -m pip $(PIP) --only-binary :all: -c constraints.txt hatchling
	.venv-python/bin/python -m pip $(PIP) --only-binary :all: --no-build-isolation -c constraints.txt -e ".[dev]"
	.venv-python/bin/python -m pip check --disable-pip-version-check
	.venv-python/bin/python -m pytest $(QUICK) $(TESTS)

# Nothing is downloaded but what tells the versions apart. Left out: the extra `apriltag`, which has no wheel there.
check-arm64: install  ## Check that every pinned package has a wheel for 64-bit ARM (Raspberry Pi, Jetson)
	@sed -e '/^# The extra .apriltag/,$$d' -e '/^#/d' -e '/^$$/d' constraints.txt > "$${TMPDIR:-/tmp}/cdpr-pins-$$$$" && \
	"$(BIN)/python" -m pip $(PIP) --dry-run --ignore-installed --no-deps --only-binary :all: --python-version 3.11 \
	  --platform manylinux_2_28_aarch64 --platform manylinux_2_17_aarch64 --platform manylinux2014_aarch64 \
	  --target "$${TMPDIR:-/tmp}/cdpr-arm64" -r "$${TMPDIR:-/tmp}/cdpr-pins-$$$$"; \
	status=$$?; rm -f "$${TMPDIR:-/tmp}/cdpr-pins-$$$$"; exit $$status

hil: hil-runs hil-table hil-makers  ## Run the tests that need a CAN bus of the kernel, here or in virtual machines (-j2: two parts at once)

hil-runs: install  ## Its first part: whole runs, homing, a master that dies or hangs
	@"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/environment_3.yaml -o "$(VENV)/hil-plan.json" --force --json >/dev/null
	CDPR_HIL_PLAN="$$PWD/$(VENV)/hil-plan.json" "$(BIN)/python" tools/hil/run.py --part runs

hil-table: install  ## Its second part: the fault table
	"$(BIN)/python" tools/hil/run.py --part table

hil-makers: hil-epos4 hil-nanotec-c5e hil-akd  ## Its other parts: a rig of one make each, from doctor to release

hil-epos4 hil-nanotec-c5e hil-akd: install
	"$(BIN)/python" tools/hil/run.py --part $(@:hil-%=%)

hil-subset: install  ## Run those of them that take a few minutes, as .ci/run does
	"$(BIN)/python" tools/hil/run.py --limit-s 1200 -m "hil and not slow"

fuzz: install  ## Feed every reader and verb mutated files and odd arguments for an hour (MINUTES=10 FUZZ="--calls 500")
	"$(BIN)/python" tools/fuzz/run.py --minutes $(or $(MINUTES),60) --seed 1 $(FUZZ)

lint: install  ## Check style, types, import contracts, and that the docs build without a warning
	"$(BIN)/python" -m ruff check
	"$(BIN)/python" -m ruff format --check
	"$(BIN)/python" -m mypy
	"$(BIN)/python" -m mypy examples/*.py
	"$(BIN)/lint-imports"
	"$(BIN)/python" -m mkdocs build --strict --quiet

docs: install  ## Build the documentation into site/
	"$(BIN)/python" -m mkdocs build --strict
	@echo "Open site/index.html"

docs-run: install  ## Run the commands of README and docs in order, from an empty folder (FAST=1: not those in real time)
	"$(BIN)/python" tools/run_docs.py $(if $(FAST),--fast)

wheel: install  ## Build the wheel into dist/ and try it in a clean environment outside the repository
	"$(BIN)/python" tools/wheel.py

schema: install  ## Write the JSON schemas of the rig, scene and plan files into docs/schema/
	"$(BIN)/python" tools/schemas.py

clean:  ## Remove build output and caches (never .venv or your runs)
	rm -rf build dist site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find $(PACKAGES) tests benchmarks tools examples -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean  ## Remove .venv too (never your runs)
	rm -rf "$(VENV)" "$(REPLACED)" .venv-lowest .venv-python
