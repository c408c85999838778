PYTHON ?= python3
TEST_JOBS ?= 2
RUN_DIR ?= runs/highway-fast-ppo

.DEFAULT_GOAL := help
.PHONY: help .venv train test check bench bench-check clean

help: ## list the targets
	@awk -F ':.*## ' '/^[.a-z-]+:.*## / { printf "make %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

.venv: .venv/.installed ## install the package and its tools, at the versions of constraints.txt, into .venv

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install -c constraints.txt -e '.[all,envpool,dev]'
	touch $@

train: .venv/.installed ## train a policy on highway-fast-v0 into RUN_DIR (continues a run that was stopped), evaluate and film it
	.venv/bin/python train_policy.py --resume --out $(RUN_DIR)

test: .venv/.installed ## run the tests, TEST_JOBS at a time
	.venv/bin/python -m pytest -n $(TEST_JOBS)

check: .venv/.installed ## lint, formatting, types, who may import whom
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

bench: .venv/.installed ## measure the speed of everything: one table, and runs/benchmarks.json
	.venv/bin/python -m benchmarks

bench-check: .venv/.installed ## a quick run, compared with the committed baseline by ratios; fails if anything got slower
	.venv/bin/python -m benchmarks --quick --baseline benchmarks/baseline.json

clean: ## remove .venv, builds and caches; keep runs and data
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name .git -prune -o -type d -name __pycache__ -prune -exec rm -rf {} +
