.PHONY: setup demo test check clean

setup:  ## virtual environment in .venv, system libraries for Open3D
	tools/setup.sh

demo: setup  ## a generated drive through the whole system
	.venv/bin/laser-slam demo

test: setup  ## the tests
	.venv/bin/python -m pytest

check: setup  ## style, types and tests
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/mypy
	.venv/bin/python -m pytest

clean:  ## remove the virtual environment
	rm -rf .venv
