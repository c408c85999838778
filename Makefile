PYTHON ?= python3
TEST_JOBS ?= 2
DOCS_JOBS ?= 16
KILLS ?= 10
POINTS ?= 10
SOAK_STEPS ?= 1000000
FUZZ_SECONDS ?= 300
EXTRAS ?= core scores envs rl study contrib tune hub ray envpool
RUN_DIR ?= runs/highway-fast-ppo

.DEFAULT_GOAL := help
# Two installations at once into one environment damage it.
.NOTPARALLEL:
.PHONY: help .venv train test test-all test-shapes test-cluster storm soak sbom fuzz check docs docs-check install-check bench bench-check clean

help: ## list the targets
	@awk -F ':.*## ' '/^[.a-z-]+:.*## / { printf "make %-13s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

.venv: .venv/.tools ## install the package and its tools, at the versions of constraints.txt, into .venv

.venv/.tools: .venv/.package
	.venv/bin/python -m pip install -c constraints.txt -e '.[all,envpool,dev]'
	touch $@

.venv/.package: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install -c constraints.txt -e '.[all]'
	touch $@

train: .venv/.package ## train a policy on highway-fast-v0 into RUN_DIR (continues a run that was stopped), evaluate and film it
	.venv/bin/python train_policy.py --what-if --num-samples 6 --steps 3000 --num-envs 2 --selections 3 --set gamma=0.85 --resume --out $(RUN_DIR)

# Checks shapes and types of every call; without the checker at the end nothing is checked.
SHAPES = --jaxtyping-packages=envs,predictor,agents,beartype.beartype

PYTEST = .venv/bin/python -m pytest -n $(TEST_JOBS) --dist worksteal

test: .venv/.tools ## run the tests but the slow ones, TEST_JOBS at a time; TEST_ARGS are pytest's
	$(PYTEST) $(TEST_ARGS)

test-all: .venv/.tools ## run the slow tests as well: takes three times as long
	$(PYTEST) -m 'not cluster' $(TEST_ARGS)

test-cluster: .venv/.tools ## run the tests on a Ray cluster of three nodes on this machine: two minutes
	.venv/bin/python -m pip install -q -c constraints.txt -e '.[all,ray]'
	.venv/bin/python -m pytest -m cluster tests/test_cluster.py

test-shapes: .venv/.tools ## make test with shapes and types of every call checked: takes twice as long
	$(PYTEST) $(SHAPES) $(TEST_ARGS)

storm: .venv/.tools ## kill the commands at random moments, fill their disks (KILLS and POINTS times), try all bad inputs
	.venv/bin/python -m tests.storm.kills --kills $(KILLS)
	.venv/bin/python -m tests.storm.full_disk --points $(POINTS)
	.venv/bin/python -W ignore -m tests.hostile.all

fuzz: .venv/.tools ## fuzz what is read from files, each kind for FUZZ_SECONDS (Linux)
	.venv/bin/python -m pip install -q -c constraints.txt -e '.[all,fuzz]'
	for entry in json toml csv amc tracks texts safetensors store zip; do \
		.venv/bin/python -m tests.fuzz $$entry --seconds $(FUZZ_SECONDS) || exit 1; done

sbom: .venv/.tools ## write the bill of materials of the pinned packages, build/sbom.json; fails if a known weakness is among them
	.venv/bin/python .ci/sbom.py

soak: .venv/.tools ## step vector environments with forecasts SOAK_STEPS times each, and check that nothing grows: 10 to 25 minutes
	.venv/bin/python -m tests.storm.soak --steps $(SOAK_STEPS)

check: .venv/.tools ## lint, formatting, types, who may import whom, the shape of the tree, the examples in docstrings
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports
	.venv/bin/python -m docs.write_tables --check
	.venv/bin/python .ci/sbom.py --only-check
	.venv/bin/python -m pytest -q -o addopts=--import-mode=importlib --doctest-modules \
		predictor envs agents dgvae_rl benchmarks train_policy.py tests/test_structure.py

.venv/.site: .venv/.package
	.venv/bin/python -m pip install -c constraints.txt -e '.[all,docs]'
	touch $@

docs: .venv/.site ## build the site into build/site: runs the tutorials, fails on a warning or a dead link
	rm -rf build/site
	.venv/bin/python -m sphinx -W --keep-going -E -q -j $(DOCS_JOBS) -c docs -d build/site-cache . build/site
	.venv/bin/python -m docs.check_links build/site

docs-check: .venv/.tools ## run every block of README.md and docs/ as written, in a copy of the tree; DOCS_ARGS are .ci/docs_check.py's
	.venv/bin/python .ci/docs_check.py --jobs $(TEST_JOBS) $(DOCS_ARGS)

install-check: ## build the wheel and try EXTRAS, each in a fresh environment: five minutes and 2 GB each
	$(PYTHON) .ci/install_check.py --only $(EXTRAS)

bench: .venv/.tools ## measure the speed of everything: one table, and runs/benchmarks.json
	.venv/bin/python -m benchmarks

bench-check: .venv/.tools ## a quick run, compared with the committed baseline by ratios; fails if anything got slower or costs more than promised
	.venv/bin/python -m benchmarks --quick --baseline benchmarks/baseline.json

clean: ## remove .venv, builds and caches; keep runs and data
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name .git -prune -o -type d -name __pycache__ -prune -exec rm -rf {} +
