VENV ?= .venv

.PHONY: setup demo test lint check clean

setup:  ## virtual environment in $(VENV) with all that developers need
	tools/setup.sh $(VENV) dev

demo:  ## a generated drive through the whole system
	tools/setup.sh $(VENV)
	$(VENV)/bin/laser-slam demo

test: setup  ## the tests
	$(VENV)/bin/python -m pytest

lint: setup  ## style and types
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy

check: lint test  ## all of it, as the continuous integration does

clean:  ## remove the virtual environment
	rm -rf $(VENV)
