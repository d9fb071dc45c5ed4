# make demo   install into .venv and run everything on a scene that is drawn for it
# make test   install into .venv and run all checks and tests
# make test-all   the same with the tests that take long
# make mutants [ARGS="mcaptrack/evaluation/metrics --count 20 --seed 2"]   change the code at random; print what no test notices

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# Every package, those that build included, comes in the version that constraints.txt names. pip would take an absolute
# path with a blank in it for two.
export PIP_CONSTRAINT := constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test test-all mutants clean

demo: $(VENV)/installed
	$(BIN)/mcaptrack demo --output mcaptrack-demo --force

test: $(VENV)/installed-for-tests
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/pytest --numprocesses auto --dist worksteal

test-all: test
	$(BIN)/pytest -m thorough --numprocesses auto --dist worksteal

mutants: $(VENV)/installed-for-tests
	$(BIN)/python -m tools.mutants $(ARGS)

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/installed-for-tests: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable ".[test]"
	# An oracle for scores, without what it depends on: its arithmetic needs none of it, and it would bring a second OpenCV.
	$(BIN)/python -m pip install --quiet --no-deps trackeval
	touch $@

clean:
	rm -rf $(VENV) mcaptrack-demo build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache
