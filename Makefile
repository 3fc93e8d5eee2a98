# Two commands do all the set-up: `make demo` and `make test`. They need Python 3.11+ and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# What README installs and nothing else: the pages' commands run there.
README_VENV := .venv-readme
# As `softneck` itself has it: on busy cores the threads of two workers wait for each other, ten times as long as they work.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test slow check docs documents benchmark conformance mutate native wheel tag constraints nightly nightly-tests nightly-documents nightly-fuzz nightly-fmu nightly-can nightly-systemd clean

demo: $(VENV)/.installed
	$(BIN)/softneck demo -o build/demo

# Run the blocks of README and of the pages as a newcomer does: installed from the checkout without tests' packages.
# `PAGES="--page docs/howto/loops.md"` runs one.
documents: $(README_VENV)/.made
	$(README_VENV)/bin/python -m pip install --quiet --disable-pip-version-check '.[drives]'
	$(PYTHON) tests/docs/run_documents.py --python $(README_VENV)/bin/python --jobs 2 $(PAGES)

# Neighbours stay with one worker: what a module makes once is made once.
test: $(VENV)/.tested
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m "not slow"

# What takes long: CI runs it too.
slow: $(VENV)/.tested
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m "slow and not nightly"

check: $(VENV)/.linted
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --threads 2
	$(BIN)/lint-imports --no-cache
	$(BIN)/python tests/test_prose.py

docs: $(VENV)/.documented
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build/html
	@echo docs/_build/html/index.html

benchmark: $(VENV)/.tested
	$(BIN)/python -m pytest tests/benchmarks --benchmark-only

# Every kind of FMU in every independent tool that is here, in Co-Simulation and Model Exchange; what is absent is
# "not run". It writes the table of docs/howto/conformance.md.
conformance: $(VENV)/.tested
	$(BIN)/python -m tests.fmu.conformance --page docs/howto/conformance.md

# Mutation tests of the code for safety and certificates: change one thing at a time and see whether a test fails. An hour
# or more for all; `make mutate AREAS="master loop"` tries some. docs/howto/nightly.md has the figures.
mutate: $(VENV)/.mutated
	$(BIN)/python tests/mutation/run.py $(AREAS) --out build/mutation.json

# The library of compiled FMUs for all five platforms, cross-compiled by zig into softneck/fmu/compiled/binaries.
native: $(VENV)/.crossed
	$(BIN)/python -m softneck.fmu.compiled

nightly: nightly-tests nightly-documents nightly-fuzz nightly-fmu nightly-can nightly-systemd

# With `make test` and `make slow` that is all: every kind in every importer, predictive control over every kind.
nightly-tests: $(VENV)/.tested
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m nightly

# The pages that take minutes.
nightly-documents:
	$(MAKE) documents PAGES=--nightly

# 100,000 damaged files, spread over the formats that we read; each is a file or one error of ours.
nightly-fuzz: $(VENV)/.tested
	SOFTNECK_FUZZ_INPUTS=100000 $(BIN)/python -m pytest -q -n 2 --dist worksteal tests/fuzz

# The library on other platforms, bit for bit; wrong bytes under the sanitizers; libFuzzer for two minutes.
# Debian: wine64 qemu-user libc6-arm64-cross gcc clang.
nightly-fmu: $(VENV)/.tested native
	SOFTNECK_NIGHTLY=1 $(BIN)/python -m pytest -q -n 0 tests/fmu/test_native_platforms.py
	SOFTNECK_FUZZ_ROUNDS=300 $(BIN)/python -m pytest -q -n 0 tests/fmu/test_native_errors.py -k sanitizers
	SOFTNECK_FUZZ_SECONDS=120 $(BIN)/python -m pytest -q -n 0 -s tests/fmu/test_native_fuzzer.py

# In QEMU, with Debian's kernel: the drives over real SocketCAN, and the service under a real systemd.
# Debian: qemu-system-x86 busybox-static kmod cpio iproute2. Without KVM 20 to 40 minutes each.
nightly-can: $(VENV)/.tested
	$(BIN)/python tests/nightly/socketcan.py

nightly-systemd: $(VENV)/.tested
	$(BIN)/python tests/nightly/systemd_unit.py

# Exporting from this wheel needs no compiler; the last line shows it.
wheel: native
	rm -rf build/dist
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir build/dist .
	$(BIN)/python tests/nightly/wheel.py build/dist/*.whl

# The version stands in softneck/__init__.py alone; the tag says the same.
tag: $(VENV)/.tested
	$(BIN)/python -m pytest -q tests/test_packaging.py
	$(BIN)/python -c "import softneck, subprocess as s; v = softneck.__version__; s.run(['git', 'tag', '-a', f'v{v}', '-m', f'softneck {v}'], check=True)"

# The versions that CI installs, from the environment in which everything was tested; names and versions alone.
constraints: $(VENV)/.documented $(VENV)/.linted $(VENV)/.mutated $(VENV)/.crossed
	$(BIN)/python -m pip freeze --quiet --exclude-editable | grep -E '^[A-Za-z0-9._-]+==[A-Za-z0-9.]+$$' > .ci/constraints.txt

clean:
	rm -rf $(VENV) $(README_VENV) docs/_build .pytest_cache .ruff_cache

# Each stamp is made anew when the dependencies change.
$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "softneck needs Python 3.11 or newer")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[drives]'
	$(BIN)/softneck doctor
	@touch $@

$(VENV)/.tested: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[all]' --group test --group importers
	@touch $@

$(VENV)/.mutated: $(VENV)/.tested
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --group mutate
	@touch $@

$(VENV)/.crossed: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --group native
	@touch $@

$(VENV)/.linted: $(VENV)/.tested
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --group lint
	@touch $@

$(VENV)/.documented: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[all]' --group docs
	@touch $@

$(README_VENV)/.made: pyproject.toml
	$(PYTHON) -m venv --clear $(README_VENV)
	$(README_VENV)/bin/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"
	@touch $@
