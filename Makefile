.PHONY: .venv demo demo-network pictures test test-all fuzz bench docs lint clean

PYTHON ?= python3
BIN := .venv/bin

# The target is a stamp and not the folder, whose modification time changes with every file added.
STAMP := .venv/.installed

DEMOS := lightmap atlas probe bake smoke smoke_light smoke_network ops_march ops_bc7 fluid_control ops_silhouette scene

# Two demos at a time, in this order: compiling kernels, which takes most of the time, keeps one core busy. The gallery
# shows files of the others.
demo: $(STAMP)
	$(MAKE) --no-print-directory -j 2 $(DEMOS:%=%.demo)
	$(BIN)/python demos/gallery.py

%.demo:
	$(BIN)/python demos/$*.py

demo-network: $(STAMP)
	$(BIN)/python demos/smoke_network.py --train

# Makes the pictures of README and docs from the output of the demos and of the tutorials, and the plots from the
# committed results; WLM_THREE names three.js.
pictures: demo
	$(BIN)/python demos/tutorials.py
	$(BIN)/python -m demos.pictures
	$(BIN)/python -m benchmarks plots

# Python keeps the compiled form of modules and tests, even where the environment turns that off: each of the many
# commands that the tests start would otherwise compile the whole package again.
export PYTHONDONTWRITEBYTECODE =

# The tests of a file stay on one worker, so that fixtures of a module are made once.
test: lint
	$(BIN)/pytest -n 2 --dist loadfile

test-all: lint
	WLM_FUZZ_CASES=200 $(BIN)/pytest -n 2 --dist loadfile -m ""

# Reads up to 20,000 changed files of each kind, which takes some hours on two cores.
fuzz: $(STAMP)
	WLM_FUZZ_CASES=20000 $(BIN)/pytest -n auto -m "" tests/fuzz

# Builds the documents as a site, out/docs/index.html; a broken link is an error.
docs: $(STAMP)
	$(BIN)/pip install -q -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: $(STAMP)
	mkdir -p out
	$(BIN)/python -m benchmarks lightmap --quick --json out/bench.json
	$(BIN)/python -m benchmarks probe --quick --json out/bench.json
	$(BIN)/python -m benchmarks atlas --quick --json out/bench.json
	$(BIN)/python -m benchmarks smoke --quick --json out/bench.json
	$(BIN)/python -m benchmarks smoke-network --quick --profile fast --json out/bench.json
	for system in lightmap probe atlas smoke smoke-network; do \
		$(BIN)/python -m benchmarks plot out/bench.json --system $$system -o out/bench-$$system.png; done

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/mypy

.venv: $(STAMP)

$(STAMP): pyproject.toml setup.py constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -c constraints.txt -e '.[test,baselines,view]'
	touch $@

clean:
	rm -rf .venv .cache .pytest_cache .mypy_cache .ruff_cache build *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
