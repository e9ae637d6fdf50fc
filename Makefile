# Every target sets up what it needs. Another Python: make PYTHON=python3.12 …
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PACKAGES := engine operators fruitlangs_addon benchmarks
SCRIPT_PACKAGES := orchard encoder fitting
SCRIPTS := $(basename $(notdir $(wildcard scripts/*.py)))

.PHONY: demo test lint types pytest baseline extension clean

demo: $(READY)
	$(BIN)/python scripts/count_fruit.py examples/orchard_tree --prompt apple --out results/demo

test: lint types pytest

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy wants the package under its name; the checkout's folder may be called anything.
types: $(READY)
	mkdir -p .types && ln -sfn "$(CURDIR)" .types/fruitlangs
	MYPYPATH=.types $(BIN)/mypy $(addprefix -p fruitlangs.,$(PACKAGES))
	MYPYPATH=.types:scripts $(BIN)/mypy $(addprefix -p ,$(SCRIPT_PACKAGES)) $(addprefix -m ,$(SCRIPTS))

pytest: $(READY)
	$(BIN)/python -m pytest

# About an hour on two cores; goes on where it stopped.
baseline: $(READY)
	$(BIN)/python scripts/evaluate.py $(addsuffix -small:101,apple plum lemon pear peach mango) \
		--out results/baseline --publish benchmarks

extension: $(READY)
	$(BIN)/python scripts/build_extension.py

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[bpy,dev]"
	touch $(READY)

clean:
	rm -rf $(VENV) .types build dist results *.egg-info
