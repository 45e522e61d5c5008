# Everything a user or a developer types. Paths are relative, so a folder whose name has spaces works.
PYTHON ?= python3

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
PIP := install --quiet --disable-pip-version-check
PACKAGES := cdpr planner executor drivers tracking calibration simulation
COMPILE_EDGES := from cdpr.cli.compiling import ready_to_measure; ready_to_measure(shown=False)

# A sourced ROS or Conda shell puts its own packages in front of ours.
unexport PYTHONPATH PYTHONHOME

.DEFAULT_GOAL := help
.PHONY: help install demo test hil hil-subset lint docs schema clean distclean

help:  ## Show this help
	@echo "cdpr: plan, prove, run and measure paths of cable-driven parallel robots"
	@echo
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile
	@echo
	@echo "The Python to build on: make PYTHON=python3.12 ... (3.11 or newer; now: $(PYTHON))"

# Nothing is installed while the stamp agrees with the pins, the Python and the folder (console scripts hold its
# absolute path), so everything works without a network after the first time.
install:  ## Create .venv and install everything into it, pinned (once)
	@place="$$("$(PYTHON)" -V 2>&1) in $$PWD"; \
	pins="$$(cat pyproject.toml constraints.txt | cksum)"; \
	stamp="$$(cat "$(STAMP)" 2>/dev/null)"; \
	if [ "$$stamp" = "$$place, $$pins" ] && [ -x "$(BIN)/python" ]; then exit 0; fi; \
	"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "cdpr needs Python 3.11 or newer; $(PYTHON) is $$("$(PYTHON)" -V 2>/dev/null || echo 'not there')." >&2; \
	  echo "Next: install one and name it, for example: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }; \
	"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "$(PYTHON) has no venv module. Next, on Debian or Ubuntu: sudo apt-get install python3-venv" >&2; exit 1; }; \
	echo "Installing into $(VENV) (once; needs the network) ..."; \
	case "$$stamp" in "" | "$$place, "*) ;; *) rm -rf "$(VENV)" ;; esac; \
	rm -f "$(STAMP)"; \
	"$(PYTHON)" -m venv "$(VENV)" && \
	"$(BIN)/python" -m pip $(PIP) --only-binary :all: -c constraints.txt hatchling && \
	"$(BIN)/python" -m pip $(PIP) --only-binary :all: --no-build-isolation -c constraints.txt -e ".[dev]" && \
	"$(BIN)/python" -m pip check --disable-pip-version-check && \
	echo "Compiling the planner and the tags' edge finder (once; a minute or two) ..." && \
	"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/environment_1.yaml -o "$(VENV)/first-plan.json" --force --json >/dev/null && \
	"$(BIN)/python" -c '$(COMPILE_EDGES)' && \
	echo "$$place, $$pins" > "$(STAMP)"

demo: install  ## Plan, prove, run and report the paper's first environment on simulated drives
	"$(BIN)/cdpr" demo

# Kernels of searches and edges that the installation did not run are compiled first, by one process each: the tests' own
# processes would compile them twice.
test: install  ## Run the whole test suite on two cores
	@"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/environment_1.yaml --planner adaptive \
	  -o "$(VENV)/paper-plan.json" --force --json >/dev/null & paper=$$!; \
	"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/turn.yaml --free-rotation --rounds 1 \
	  -o "$(VENV)/turning-plan.json" --force --json >/dev/null && \
	"$(BIN)/python" -c '$(COMPILE_EDGES)' && \
	wait $$paper
	"$(BIN)/python" -m pytest -n 2

hil: install  ## Run the tests that need a CAN bus of the kernel, here or in a virtual machine
	@"$(BIN)/cdpr" plan configs/gachon_8_6.yaml configs/environment_3.yaml -o "$(VENV)/hil-plan.json" --force --json >/dev/null
	CDPR_HIL_PLAN="$$PWD/$(VENV)/hil-plan.json" "$(BIN)/python" tools/hil/run.py

hil-subset: install  ## Run those of them that take a few minutes, as .ci/run does
	"$(BIN)/python" tools/hil/run.py --limit-s 1200 -m "hil and not slow"

lint: install  ## Check style, types, import contracts, and that the docs build without a warning
	"$(BIN)/python" -m ruff check
	"$(BIN)/python" -m ruff format --check
	"$(BIN)/python" -m mypy
	"$(BIN)/lint-imports"
	"$(BIN)/python" -m mkdocs build --strict --quiet

docs: install  ## Build the documentation into site/
	"$(BIN)/python" -m mkdocs build --strict
	@echo "Open site/index.html"

schema: install  ## Write the JSON schemas of the rig, scene and plan files into docs/schema/
	"$(BIN)/python" -m cdpr.schema

clean:  ## Remove build output and caches (never .venv or your runs)
	rm -rf build dist site htmlcov .coverage .coverage.* .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find $(PACKAGES) tests -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean  ## Remove .venv too
	rm -rf "$(VENV)"
