# Every target makes its own environment in .venv and needs nothing but Python 3.11+ (and Mesa's EGL for the film).
PYTHON ?= python3
BIN := .venv/bin
DEMO := demo/$(shell date +%Y-%m-%d_%H-%M-%S)

.PHONY: demo train test lint format type bench

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch .venv/ready

## The paper's comparison in small: 2 rollouts of up to 2000 steps per method and terrain; prints the report's path.
demo: .venv/ready
	$(BIN)/python -m quadhrl.eval.grid --rollouts 2 --rules.max-steps 2000 --rules.end-when-stuck --out $(DEMO)

## Train the footstep policy on level ground for a few minutes, plot its learning curve and film it.
train: .venv/ready
	$(BIN)/python -m quadhrl.trainers.ppo --preset cpu --infill 1 --height-range 0 --total-steps 8000000 \
		--max-minutes 9 --log-dir $(dir $(DEMO)) --run-name $(notdir $(DEMO))
	$(BIN)/python -m quadhrl.eval.curves $(DEMO) --out $(DEMO)/curves.png
	$(BIN)/python -m quadhrl.eval.play $(DEMO) --video $(DEMO)/walk.mp4 --seconds 10

test: .venv/ready
	$(BIN)/python -m pytest

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: .venv/ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

type: .venv/ready
	$(BIN)/pyright --pythonpath $(BIN)/python

bench: .venv/ready
	$(BIN)/python benchmarks/throughput.py
	$(BIN)/python benchmarks/hlp.py
