# Two commands for a stranger: `make demo` and `make test`. Both set up everything and skip what is done.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO := runs/demo

.PHONY: install demo test lint clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14) and "Python 3.11 to 3.13 is needed")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev,sweep]'
	touch $@

demo: $(DEMO)/renders/orbit.mp4
	@echo "contact sheet  $(DEMO)/contact_sheet_test.png  (prediction | truth | error, held-out views at unseen times)"
	@echo "video          $(DEMO)/renders/orbit.mp4"
	@echo "scores         $(DEMO)/metrics.json"

$(DEMO)/metrics.json: | $(STAMP)
	rm -rf $(DEMO)
	$(BIN)/python scripts/train.py experiment=demo out_dir=$(DEMO)

$(DEMO)/renders/orbit.mp4: $(DEMO)/metrics.json
	$(BIN)/python scripts/render.py run=$(DEMO) path=orbit time=pingpong num_frames=60 fps=30 format=mp4

test: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist worksteal

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) runs outputs multirun
