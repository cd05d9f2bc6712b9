# make install | test | faults | soak | demo | docs
# Torch is the CUDA build on pip's public index; PIP_EXTRA_INDEX_URL can name another index, for example for CPU wheels.
export DO_NOT_TRACK := 1

PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed
SUBJECTS ?= 6

.PHONY: install test faults soak demo docs

install: $(INSTALLED)

# Install torch first, at its pinned version: otherwise pip's resolver may download several builds of it.
$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt torch
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	test -s .env || (umask 077; $(BIN)/python -m flows.server_password > .env)
	$(BIN)/python -c 'from hnerf.body.anny import anny_rig; anny_rig()'  # takes a minute, the first time on a machine
	$(BIN)/hnerf models || echo "warning: no networks; what needs them says so (hnerf models)" >&2
	touch $@

# Keep bytecode: tests start many processes, each of which would otherwise compile the same code again. Some tests only
# wait for these processes, so three workers keep two cores busy.
test: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	env -u PYTHONDONTWRITEBYTECODE OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses 3 --dist worksteal

faults: $(INSTALLED)
	OMP_NUM_THREADS=1 $(BIN)/python tests/faults.py

soak: $(INSTALLED)
	OMP_NUM_THREADS=1 $(BIN)/pytest -m soak
	$(BIN)/python tests/soak.py --subjects $(SUBJECTS)

demo: $(INSTALLED)
	$(BIN)/hnerf demo

docs: $(INSTALLED)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[docs]'
	$(BIN)/mkdocs build --strict
