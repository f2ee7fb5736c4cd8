# Every target sets up its own virtual environment in .venv; nothing is installed outside it.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
# On two processes of one thread each, and by file: what the tests of a file share is made once.
BY_FILE := -n 2 --dist loadfile
test fast nightly coverage: export OMP_NUM_THREADS := 1
# Empty is unset: the tests start a hundred processes, and what one has compiled the next need not.
export PYTHONDONTWRITEBYTECODE :=
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet install --constraint constraints.txt

.PHONY: help solve test fast extras nightly coverage mutation lint format types check release golden golden-renew \
	reference bench \
	evidence figures notebooks site clean
help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "%-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

solve: $(VENV)/.solve  ## set up and plan Reconnaissance B from a cold start
	$(BIN)/python -m scp_recon.solve --init cold

test: $(VENV)/.test  ## set up and run the tests on two processes
	$(BIN)/python -m pytest $(BY_FILE)

fast: $(VENV)/.test  ## run, in a minute, the tests that an edit most likely breaks
	$(BIN)/python -m pytest $(BY_FILE) -m "not slow"

extras: $(VENV)/.extras  ## set up all that the commands can need: reports, campaigns, kernels, the spacecraft

lint: $(VENV)/.dev  ## lint and check the format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/.dev  ## format, and fix what can be fixed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/.dev  ## check the types
	$(BIN)/mypy

nightly: $(VENV)/.test $(VENV)/.docs $(VENV)/.evidence  ## look harder: 500 examples a property, and counts of what they tried
	HYPOTHESIS_PROFILE=nightly $(BIN)/python -m pytest $(BY_FILE) --timeout 3600 \
	--reliability=runs/reliability.json
	$(BIN)/python -m experiments evidence --check

coverage: $(VENV)/.dev  ## lines and branches that the tests reach
	$(BIN)/python -m pytest $(BY_FILE) --cov --cov-report term --cov-report json:runs/coverage.json

mutation: $(VENV)/.dev  ## change formulations in every small way, and see which changes no test notices
	HYPOTHESIS_PROFILE=mutation OMP_NUM_THREADS=1 $(BIN)/mutmut run --max-children 2
	$(BIN)/mutmut results

golden: $(VENV)/.test  ## run fifty commands, and compare what they answer with tests/golden.json
	$(BIN)/python -m tests.golden

golden-renew: $(VENV)/.test  ## write tests/golden.json anew, and show what moved by how much
	$(BIN)/python -m tests.golden --renew

reference: $(VENV)/.solve  ## write docs/reference and the JSON schema of scenarios from the code
	$(BIN)/python -m scp_recon.reference docs/reference
	$(BIN)/python -m scp_recon schema docs/scenario.schema.json

bench: $(VENV)/.dev  ## time everything
	$(BIN)/python -m benchmarks

evidence: $(VENV)/.evidence  ## renew evidence whose results have moved
	$(BIN)/python -m experiments evidence

check: lint types test  ## everything that a change has to pass

release: check golden $(VENV)/.evidence  ## all that a release has to pass, then new timings and counts
	$(BIN)/python -m experiments evidence --check
	$(BIN)/python -m experiments evidence --dated

figures: $(VENV)/.test  ## draw the paper's figures, and those of docs that no study feeds
	test -d runs/paper || $(BIN)/python -m experiments observation_table
	$(BIN)/python -m paper_figs
	$(BIN)/python -m paper_figs modes --out docs/modes.png
	$(BIN)/python -m scp_recon.solve --init cold --out runs/flyby
	$(BIN)/python -m paper_figs flyby --runs runs/flyby --out docs/flyby.png

notebooks: $(VENV)/.notebooks  ## run the notebooks, and keep each as a page in runs/notebooks
	for name in $(basename $(notdir $(wildcard examples/notebooks/*.py))); do \
	$(BIN)/jupytext --quiet --to ipynb --output - examples/notebooks/$$name.py | OMP_NUM_THREADS=1 PLOTLY_RENDERER=notebook \
	$(BIN)/jupyter-nbconvert --log-level ERROR --KernelManager.transport=ipc --stdin --execute --to html \
	--output-dir runs/notebooks --output $$name || exit 1; done

site: $(VENV)/.docs  ## build the pages as a site in runs/site, notebooks as they ran last; any warning or broken link fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:  ## remove the environment and what it produced
	rm -rf $(VENV) runs mutants .coverage .mypy_cache .ruff_cache .pytest_cache .hypothesis *.egg-info

$(VENV)/.venv:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed, and none was found" >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV) || { echo "$(PYTHON) cannot make a virtual environment: \
	on Debian and Ubuntu its package python3-venv is missing" >&2; exit 1; }
	@touch $@

$(VENV)/.solve: $(VENV)/.venv pyproject.toml constraints.txt
	$(PIP) --editable .
	@touch $@

$(VENV)/.extras: $(VENV)/.venv pyproject.toml constraints.txt
	$(PIP) --editable '.[all]'
	@touch $@

$(VENV)/.test: $(VENV)/.venv pyproject.toml constraints.txt
	$(PIP) --editable '.[report,test]'
	@touch $@

$(VENV)/.evidence: $(VENV)/.venv pyproject.toml constraints.txt
	$(PIP) --editable '.[all,crosscheck,peers,test,dev]'
	@touch $@

$(VENV)/.docs: $(VENV)/.venv pyproject.toml constraints.txt
	$(PIP) --editable '.[docs]'
	@touch $@

$(VENV)/.notebooks: $(VENV)/.venv pyproject.toml constraints.txt
	$(PIP) --editable '.[notebooks]'
	@touch $@

$(VENV)/.dev: $(VENV)/.venv pyproject.toml constraints.txt
	$(PIP) --editable '.[report,test,dev]'
	@touch $@
