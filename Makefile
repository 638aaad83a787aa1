# `make demo` and `make test` each do all of their own set-up in .venv; nothing else is needed but Python 3.11-3.13.

VENV := .venv
BIN := $(VENV)/bin

# Half of the tests wait for servers and browsers: one worker more than there are cores.
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2) + 1)
# Which of the tests marked long run: none, all, or share:TEXT: a sixtieth of them, and a twentieth of those marked slow,
# that the text draws.
LONG ?= none

.PHONY: demo check test test-all docs browser release clean

demo: $(VENV)/.installed
	@$(BIN)/ladarreg demo

docs: $(VENV)/.installed-dev
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet && echo "build/docs/index.html"

# Everything runs even where an earlier check fails, so that pytest's closing line is always the last; any failure fails.
# mypy is one of the tests (tests/architecture/test_types.py), so that it works beside the others. Compiled files are kept:
# without them every worker rewrites the assertions of all tests again.
define run_checks
	@status=0; \
	echo "ruff check"; $(BIN)/ruff check . || status=1; \
	echo "ruff format --check"; $(BIN)/ruff format --check --quiet . || status=1; \
	env -u PYTHONDONTWRITEBYTECODE OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal $(1) || status=1; \
	exit $$status
endef

check: $(VENV)/.installed-dev browser
	$(call run_checks,-m "not slow")

test: $(VENV)/.installed-dev browser
	$(call run_checks,--long=$(LONG))

test-all:
	@$(MAKE) test LONG=all

$(VENV)/.created:
	@for python in $(PYTHON) python3.13 python3.12 python3.11 python3 python; do \
		if $$python -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; then \
			echo "$(VENV): $$($$python --version)"; \
			[ -x $(BIN)/python ] && $(BIN)/python -m pip --version >/dev/null 2>&1 || $$python -m venv --clear $(VENV) || exit 1; \
			touch $@; exit 0; \
		fi; \
	done; \
	echo "make: no Python 3.11, 3.12 or 3.13 with the venv module was found; install one or say make PYTHON=/path/to/python" >&2; \
	exit 1

$(VENV)/.installed: pyproject.toml $(VENV)/.created
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

# Not compiled ahead: tests import a part of what is installed, and compiling all of it takes as long as unpacking it.
$(VENV)/.installed-dev: pyproject.toml $(VENV)/.created
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable ".[dev]"
	@if command -v npm >/dev/null; then npm ci --silent --no-audit --no-fund || true; fi
	@touch $@ $(VENV)/.installed

# The browser tests skip with a reason where none of these ways leads to a Chromium.
browser: $(VENV)/.installed-dev
	@if $(BIN)/python -m testing.workbench.browser >/dev/null 2>&1; then exit 0; fi; \
	if command -v apt-get >/dev/null && [ "$$(id -u)" = 0 ]; then \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium >/dev/null || true; \
	fi; \
	$(BIN)/python -m testing.workbench.browser >/dev/null 2>&1 || $(BIN)/python -m playwright install chromium || true; \
	$(BIN)/python -m testing.workbench.browser || true

# Cuts a release and tries it on every supported Python that is installed; commits and uploads nothing.
release: $(VENV)/.installed-dev
	@$(BIN)/python -m testing.release $(VERSION)

clean:
	rm -rf build dist artifacts .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks
