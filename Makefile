# Every target sets up what it needs. Another Python: make PYTHON=python3.12 …
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# Other extras, without pinned versions, with one more package: make EXTRAS=dev CONSTRAINTS= PACKAGES_TOO=bpy==4.2.* …
EXTRAS ?= bpy,dev
CONSTRAINTS ?= constraints.txt
PACKAGES_TOO ?=
TESTS ?= tests
READY := $(VENV)/.ready
PACKAGES := engine operators fruitlangs_addon orchard fitting benchmarks
SCRIPTS := $(basename $(notdir $(wildcard scripts/*.py scripts/developer/*.py scripts/checks/*.py)))

.PHONY: demo test lint types kernels pytest tables stale guide extension docs wheel clean

demo: $(READY)
	$(BIN)/python scripts/count_fruit.py examples/orchard_tree --prompt apple --out results/demo

test: $(READY)
	$(MAKE) --jobs 2 lint types kernels
	$(MAKE) pytest

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy wants the package under its name; the checkout's folder may be called anything.
types: $(READY)
	mkdir -p .types && ln -sfn "$(CURDIR)" .types/fruitlangs
	MYPYPATH=.types $(BIN)/mypy $(addprefix -p fruitlangs.,$(PACKAGES))
	MYPYPATH=.types:scripts:scripts/developer:scripts/checks $(BIN)/mypy -p guide $(addprefix -m ,$(SCRIPTS))

# Otherwise each process of the tests compiles them.
kernels: $(READY)
	PYTHONPATH=scripts $(BIN)/python -c "import _checkout; from fruitlangs.engine import compile_ahead; \
		compile_ahead.is_all_compiled() or compile_ahead.compile_all()" > /dev/null

pytest: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile $(TESTS)

# The tables of docs/accuracy.md and benchmarks/RESULTS.md: many hours; goes on where it stopped.
tables: $(READY)
	$(BIN)/python scripts/developer/make_tables.py

# Only says in the tables which rows were measured with earlier code.
stale: $(READY)
	$(BIN)/python scripts/developer/make_tables.py --measure-nothing

# The pictures and the film of docs/blender.md; BLENDER opens a window, its Python has the engine's packages.
BLENDER ?= blender
guide:
	$(BLENDER) --python-exit-code 1 --enable-event-simulate --no-window-focus --window-geometry 0 0 1600 900 \
		-P scripts/developer/picture_guide.py -- --pictures docs/images/guide --film docs/images/guide/day.webp

# The small zip needs nothing installed. With all Python packages inside:
# make extension ZIPS="--wheels --blender 4.5 --platform linux-x64"
extension: $(if $(ZIPS),$(READY))
	$(if $(ZIPS),$(BIN)/python,$(PYTHON)) scripts/developer/build_extension.py $(ZIPS)

# The documentation site, in build/site.
docs: $(READY)
	$(BIN)/python scripts/developer/build_site.py

wheel: $(READY)
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(if $(CONSTRAINTS),--constraint $(CONSTRAINTS)) --editable ".[$(EXTRAS)]" $(PACKAGES_TOO)
	touch $(READY)

clean:
	rm -rf $(VENV) .types build dist results *.egg-info
