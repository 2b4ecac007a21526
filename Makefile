# `make help` lists what there is. Needs Python 3.11 or newer, make and pip; everything else goes into .venv.
#
#   TORCH_INDEX  package index for torch alone, e.g. https://download.pytorch.org/whl/cu128; empty: pip's own index,
#                which on Linux is usually a CUDA build of several GB. Default: the one .venv was made with; for a
#                new .venv on Linux without an NVIDIA GPU the index of CPU builds, if it answers within seconds;
#                else pip's own. Another index than that of .venv installs torch anew
#   PYTHON       the interpreter that makes .venv, and that gpu-check uses
#                (default: the first of python3, python3.13, 3.12, 3.11 that is new enough;
#                gpu-check takes .venv's where that one's torch is no CUDA build)

SHELL := /bin/bash
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
# says that .venv is finished, and holds the TORCH_INDEX it was made with; the other: that it has the tools of [dev], too
STAMP := $(VENV)/.installed
DEV_STAMP := $(VENV)/.installed-dev
INSTALLED_INDEX := $(shell cat $(STAMP) 2>/dev/null)
CPU_INDEX := https://download.pytorch.org/whl/cpu
NVIDIA = $(shell command -v nvidia-smi; ls -d /dev/nvidia* 2>/dev/null)
# the index of CPU builds, if it answers; asked by Python, for a bare machine has no curl
ANSWERING_CPU_INDEX = $(shell timeout 6 "$(PYTHON)" -c \
	'import sys, urllib.request as web; web.urlopen(sys.argv[1] + "/torch/", timeout=5)' "$(CPU_INDEX)" 2>/dev/null && echo "$(CPU_INDEX)")
NEEDS_CPU_INDEX = $(and $(filter Linux,$(shell uname -s)),$(if $(NVIDIA),,yes))
ifeq ($(origin TORCH_INDEX),undefined)
ifneq ($(wildcard $(STAMP)),)
TORCH_INDEX := $(INSTALLED_INDEX)
else
# found out once, and only where a recipe asks
TORCH_INDEX = $(eval TORCH_INDEX := $(if $(NEEDS_CPU_INDEX),$(ANSWERING_CPU_INDEX)))$(TORCH_INDEX)
endif
else ifneq ($(TORCH_INDEX),$(INSTALLED_INDEX))
.PHONY: $(STAMP)
# else pip would be content with the build that is there
REINSTALL := --force-reinstall
endif
# -qq: errors only; pip warns once per package for every local index it is configured with
PIP := $(BIN)/python -m pip --disable-pip-version-check
# an index of torch's builds has of everything else the versions it likes; those of constraints.txt come after it
TORCH_CONSTRAINTS := <(grep -E '^(torch|triton)[<>=]' constraints.txt)
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
HAS_CUDA := import sys, torch; sys.exit(torch.version.cuda is None)
# found once, and only where a recipe asks: each try starts an interpreter
FOUND_PYTHON = $(shell for each in python3 python3.13 python3.12 python3.11; do \
	"$$each" -c '$(NEW_ENOUGH)' 2>/dev/null && { echo "$$each"; break; }; done)
PYTHON ?= $(eval PYTHON := $(FOUND_PYTHON))$(PYTHON)

# What `make evaluate` measures. It takes hours, keeps each row as it finishes, and resumes
CLIPS ?= d4d_endonerf phantom:still phantom:breathing phantom:pull phantom:cut
# those of the systems of table 1, which take a processor much longer
TABLE_CLIPS ?= phantom:breathing:160x128 phantom:pull:160x128 phantom:cut:160x128 phantom:still:160x128 d4d_endonerf:320x256
TABLE_SECONDS ?= 60 1800
GRID_CLIPS ?= phantom:still:640x512 phantom:breathing:640x512 phantom:pull:640x512 phantom:cut:640x512
EVALUATE := $(BIN)/python -m lab evaluate
# the folder of the recordings: d4d_endonerf/ and so on
evaluate table1 capacity: export INTRASPLAT_DATA ?= ../shared/data

.PHONY: help setup demo test check bench gpu-check evaluate table1 capacity chaos attacks images-check sbom clean

help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 18

setup: $(STAMP) ## make .venv and install what running needs into it (TORCH_INDEX=URL chooses the torch build)
	@$(BIN)/python -c 'import torch; print(f"torch {torch.__version__}:", f"CUDA {torch.version.cuda} build" if torch.version.cuda else "CPU build")'

$(STAMP): pyproject.toml client/pyproject.toml service/pyproject.toml constraints.txt
	@if [ -z "$(PYTHON)" ] || ! "$(PYTHON)" -c '$(NEW_ENOUGH)'; then \
		echo "setup: Python 3.11 or newer is needed; $(or $(PYTHON),python3) is: $$("$(or $(PYTHON),python3)" --version 2>&1)" >&2; \
		echo "setup: install one, or name it: make setup PYTHON=/path/to/python3.12" >&2; exit 1; fi
	@if ! $(BIN)/python -c '$(NEW_ENOUGH)' 2>/dev/null; then \
		echo "setup: making $(VENV) with $$("$(PYTHON)" --version)"; \
		"$(PYTHON)" -m venv --clear $(VENV) || { echo "setup: the venv module is incomplete; on Debian or Ubuntu: apt-get install python3-venv" >&2; exit 1; }; fi
	@if [ -n "$(TORCH_INDEX)$(REINSTALL)" ]; then \
		echo "setup: installing torch from $(or $(TORCH_INDEX),pip's own index)"; \
		$(PIP) install -qq $(REINSTALL) --constraint $(TORCH_CONSTRAINTS) $(TORCH_INDEX:%=--index-url "%") torch; fi
	@echo "setup: installing intrasplat and what it needs (download sizes are in README.md; minutes on a slow line)"
	@$(PIP) install -qq --constraint constraints.txt --editable '.[charts]' --editable ./client --editable ./service
	@echo "$(TORCH_INDEX)" >$@

$(DEV_STAMP): $(STAMP)
	@echo "setup: installing what the tests and checks need besides"
	@$(PIP) install -qq --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: setup ## reconstruct a synthetic clip of tissue and render it without the instrument
	@$(BIN)/python -m lab.demo

# the whole suite runs one file more at a time than there are cores, up to four: a third of its time is waiting. Files
# go out in their order: else those of few tests come last, and they are the longest
WHOLE_SUITE = -n $(shell cores=$$(getconf _NPROCESSORS_ONLN); echo $$((cores < 3 ? cores + 1 : 4))) \
	--dist loadfile --no-loadscope-reorder

test: setup $(DEV_STAMP) ## the whole test suite; ARGS="tests/test_layers.py -k law" narrows it
	@$(BIN)/python -m pytest $(or $(ARGS),$(WHOLE_SUITE))

check: setup $(DEV_STAMP) ## style, types, the import rules and the containers' rules
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@cd client && ../$(BIN)/mypy --config-file ../pyproject.toml --cache-dir ../.mypy_cache --package intrasplat_client
	@$(BIN)/python -m pytest tests/test_layers.py tests/test_docker.py

bench: setup ## every lab/benchmarks/bm_*.py, one after the other
	@set -e; for each in lab/benchmarks/bm_*.py; do \
		[ -e "$$each" ] || { echo "bench: lab/benchmarks/ holds no bm_*.py" >&2; exit 1; }; \
		echo "== $$each"; $(BIN)/python -m $$(echo "$${each%.py}" | tr / .); done

gpu-check: ## with an NVIDIA GPU: check its kernels and time them; at most 7 minutes, docs/gpu.md
	@# nothing is installed and no .venv is made; a PYTHON that is named is used whatever it has
	@python="$(PYTHON)"; \
	if [ "$(origin PYTHON)" = file ] && [ -x $(BIN)/python ] && ! "$$python" -c '$(HAS_CUDA)' 2>/dev/null; then \
		python=$(BIN)/python; fi; \
	if ! "$$python" -c '$(NEW_ENOUGH)' 2>/dev/null; then \
		echo "gpu-check: '$$python' is no Python of 3.11 or newer; name one: make gpu-check PYTHON=/path/to/python3" >&2; exit 1; fi; \
	"$$python" lab/gpu/check.py $(ARGS)

evaluate: setup ## every preset on every clip, and the charts; takes hours, and resumes (CLIPS="phantom:pull ...")
	@$(EVALUATE) $(CLIPS) --series ours --seeds 0 1 2 --out lab/rows
	@$(EVALUATE) $(CLIPS) --series fast --budget-s 15 --seeds 0 1 2 --out lab/rows
	@$(if $(filter d4d_%,$(CLIPS)),$(EVALUATE) d4d_stereo --series instant fast --holdout every8 --eyes left both --out lab/rows)
	@$(EVALUATE) $(CLIPS) --series ablation --out lab/rows
	@$(BIN)/python -m lab.pages

table1: setup ## the systems of the paper's table 1: presets as they are, the others for TABLE_SECONDS each; takes a day, and resumes (TABLE_CLIPS=...)
	@$(EVALUATE) $(TABLE_CLIPS) --series paper fast --out lab/rows/table1
	@for seconds in $(TABLE_SECONDS); do \
		$(EVALUATE) $(TABLE_CLIPS) --series endogaussian lerplane endonerf --budget-s $$seconds --out lab/rows/table1 || exit; \
	done
	@$(BIN)/python -m lab.pages

capacity: setup ## a grid of fixed capacities beside the automatic choice; takes hours, and resumes
	@$(EVALUATE) $(GRID_CLIPS) --series fast --grid --holdout every8 --iterations 600 --seeds 0 1 2 3 4 --out lab/rows/capacity
	@$(BIN)/python -m lab.pages

chaos: setup $(DEV_STAMP) ## kill every part of a running service at every point, and count what was lost; ARGS narrows it
	@$(BIN)/python -m tests.chaos $(ARGS)

attacks: setup $(DEV_STAMP) ## replay the attacks that once stopped everybody, and measure what another tenant feels of them
	@$(BIN)/python -m tests.attacks $(ARGS)

images-check: setup $(DEV_STAMP) ## build both images and run them, where buildah and podman are; takes minutes, needs root
	@$(BIN)/python docker/check $(ARGS)

sbom: setup $(DEV_STAMP) ## build/sbom.json: every component of this environment, as CycloneDX
	@$(BIN)/python docker/sbom.py build/sbom.json

clean: ## remove .venv, caches and build leftovers; scenes and the demo's pictures stay
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find intrasplat contract worker service client lab tests -name __pycache__ -type d -prune -exec rm -rf {} +
