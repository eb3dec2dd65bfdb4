# Everything a fresh machine needs is made here: each target works alone.
.DEFAULT_GOAL := help
SHELL := /bin/bash
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready$(if $(LOCKED),-locked)
DATA ?= data/embedded
OUT ?= runs/preprocess
COUNT ?= 100
TEST_WORKERS ?= 2
ROBOT ?= panda
LOCKED ?=
EXTRAS := geometry,sim,sapien,import,view,torch,models,pipelines,pysdf,bench,dev
TOOLS := build/tools
COMMA := ,
EIGEN := $(VENV)/lib/python3.11/site-packages/cmeel.prefix/include/eigen3

.PHONY: help env demo test test-all lint format schemas preprocess correct edit generate train policy evaluate slow-tables bench consumers docs lock wheel test-wheel sbom clean

help: ## Show this page
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  DATA=$(DATA)  OUT=$(OUT)"

env: $(READY) ## Make the environment in .venv with the pinned versions; LOCKED=1 also fixes what these need, with hashes

# pysdf ships as source and needs Eigen's headers, which cmeel-eigen carries: no system package is needed. Its build looks for them in the home
# folder and would else download others, so that a locked build gets a home folder with a link to them.
PIP := $(BIN)/python -m pip install -q --disable-pip-version-check
FROM_LOCK := --no-deps --no-build-isolation
$(READY): pyproject.toml constraints.txt $(if $(LOCKED),requirements.lock requirements-source.lock)
	rm -f $(VENV)/.ready*
	$(PYTHON) -m venv $(VENV)
ifeq ($(LOCKED),)
	$(PIP) -c constraints.txt torch cmeel-eigen
	CPLUS_INCLUDE_PATH=$(abspath $(EIGEN)) $(PIP) -c constraints.txt -e '.[$(EXTRAS)]'
else
	$(PIP) --only-binary :all: --require-hashes -r requirements.lock
	mkdir -p $(VENV)/home/.local/include && ln -sfn $(abspath $(EIGEN)) $(VENV)/home/.local/include/eigen3
	PIP_CONFIG_FILE=$${PIP_CONFIG_FILE:-$$HOME/.config/pip/pip.conf} HOME=$(abspath $(VENV))/home \
	  $(PIP) $(FROM_LOCK) --require-hashes -r requirements-source.lock
	$(PIP) $(FROM_LOCK) -e .
endif
	touch $@

demo: $(READY) ## Fresh machine to 50 generated, certified, settled scenes and a contact sheet: embedded set, preprocess, generate
	$(BIN)/stable-data synth data/embedded
	$(BIN)/python -m pipelines preprocess --data data/embedded --out runs/demo
	$(BIN)/python -m pipelines generate --count 54 --assets real --assets embedded --out runs/demo-scenes --set num_pictures=50 --set scenes_per_shard=27 || [ $$? -eq 1 ]
	@$(BIN)/python -c "from stable_data.storage.run_folder import RunFolder; n = RunFolder('runs/demo-scenes').num_rows('scenes'); n < 50 and exit(f'runs/demo-scenes has {n} accepted scenes, expected at least 50; its table failures says why')"
	@echo "open runs/demo/report/index.html, runs/demo-scenes/report/index.html and its contact_sheet.png"

# The processes that tests start read the bytecode that the first one has written, also where a machine is set to write none.
test: $(READY) ## Run the tests, the slow ones left out (what CI runs)
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(TEST_WORKERS) --dist loadfile --no-loadscope-reorder

test-all: $(READY) ## Run all tests, with more examples of each property
	$(BIN)/python -m pytest -m '' --hypothesis-profile=thorough

lint: $(READY) ## Check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY) ## Format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

schemas: $(READY) ## Write schemas/ from the code
	$(BIN)/stable-data schemas

data/embedded: | $(READY)
	$(BIN)/stable-data synth $@

preprocess: $(READY) $(if $(filter data/embedded,$(DATA)),data/embedded) ## DATA=<MesaTask-10K folder> OUT=<folder> to staged, geometry-complete tables
	$(BIN)/python -m pipelines preprocess --data $(DATA) --out $(OUT)

correct: $(READY) $(if $(filter data/embedded,$(DATA)),data/embedded) ## DATA=<folder of scenes, or a run> OUT=<folder> to scenes that are exactly clean
	$(BIN)/python -m pipelines correct --scenes $(DATA) --out $(if $(filter runs/preprocess,$(OUT)),runs/correct,$(OUT))

edit: $(READY) $(if $(filter data/embedded,$(DATA)),data/embedded) ## DATA=<folder of scenes, or a run> EDITS=<file of edits> ASSETS=<further libraries> OUT=<folder> ENGINE=<embedded, transformers:FOLDER, openai:MODEL, …> to changed scenes
	$(BIN)/python -m pipelines edit --scenes $(DATA) --edits $(EDITS) --out $(if $(filter runs/preprocess,$(OUT)),runs/edit,$(OUT)) $(foreach library,$(ASSETS),--assets $(library)) $(if $(ENGINE),--engine $(ENGINE))

generate: $(READY) ## COUNT=<how many, drawn> or TASKS=<file of instructions and tables>, ASSETS=<libraries> ENGINE=<as for edit> OUT=<folder> to simulation-ready scenes
	$(BIN)/python -m pipelines generate $(if $(TASKS),--tasks $(TASKS),--count $(COUNT)) --out $(if $(filter runs/preprocess,$(OUT)),runs/generate,$(OUT)) $(foreach library,$(ASSETS),--assets $(library)) $(if $(ENGINE),--engine $(ENGINE)) || [ $$? -eq 1 ]

train: preprocess ## Point encoder, corrector and reasoner on the tables in OUT (hours on a CPU): runs/encoder, runs/corrector, runs/reasoner
	$(BIN)/python -m models.point_encoder.pretrain --out runs/encoder
	$(BIN)/python -m pipelines preprocess --data $(DATA) --out runs/encoded --set features=runs/encoder/encoder.safetensors
	$(BIN)/python -m pipelines train-corrector --data runs/encoded --out runs/corrector --preset embedded_set --config workflows/embedded.toml
	$(BIN)/python -m pipelines train-reasoner --data $(OUT) --out runs/reasoner --config workflows/embedded.toml

POLICY := $(if $(filter runs/preprocess,$(OUT)),runs/policy,$(OUT))
policy: $(READY) ## COUNT=<training scenes> ROBOT=<panda, simple, …> OUT=<folder>: from generated scenes to the success of a trained policy in unseen ones
	$(BIN)/stable-data robots --fetch $(ROBOT)
	$(BIN)/python -m pipelines generate --count $(COUNT) --seed 1 --out $(POLICY)/train || [ $$? -eq 1 ]
	$(BIN)/python -m pipelines generate --count $$(( ($(COUNT) + 1) / 2 )) --seed 2 --out $(POLICY)/test || [ $$? -eq 1 ]
	$(BIN)/python -m pipelines demonstrate --scenes $(POLICY)/train --out $(POLICY)/demonstrations --robot $(ROBOT) --set task=pick --set episodes=6 --set noise=0.05 || [ $$? -eq 1 ]
	$(BIN)/python -m pipelines train-policy --episodes $(POLICY)/demonstrations --out $(POLICY)/policy
	$(BIN)/python -m pipelines evaluate-policy --policy $(POLICY)/policy --scenes $(POLICY)/test --out $(POLICY)/result --set task=pick --set max_steps=200 || [ $$? -eq 1 ]

# On other data than the embedded set, the tasks are those of its test scenes, and its library serves them.
evaluate: $(READY) $(if $(filter data/embedded,$(DATA)),data/embedded) ## The paper's tables: DATA=<MesaTask-10K folder> LAYOUTS=<file of start layouts> OPTIONS=<more of "pipelines evaluate", such as --system or --repetitions> TABLES=all: the slow tables too
	$(BIN)/stable-data features --fetch inception || echo "without these weights (81 MB), the distance of pictures is no FID"
	$(BIN)/python -m pipelines preprocess --data $(DATA) --out runs/evaluate/data || [ $$? -eq 1 ]
	$(BIN)/python -m pipelines evaluate $(if $(filter data/embedded,$(DATA)),--count 12 --set generate.scenes_per_shard=6,--scenes runs/evaluate/data --where "split == 'test'" --assets $(DATA)) --reference runs/evaluate/data --out runs/evaluate/systems $(OPTIONS) || [ $$? -eq 1 ]
	OMP_NUM_THREADS=1 IGL_NUM_THREADS=1 $(BIN)/python -m benchmarks.correction $(DATA) $(if $(LAYOUTS),--layouts $(LAYOUTS)) --per-bucket 1 --settle --json runs/evaluate/correction.json
	$(if $(filter all,$(TABLES)),$(MAKE) slow-tables)
	$(BIN)/python -m benchmarks.paper_tables runs/evaluate

# The data of the demo have three scenes that no training saw; those of another seed have about twenty.
HELD_OUT := $(if $(filter data/embedded,$(DATA)),runs/evaluate/held_out_tables,runs/evaluate/data)
slow-tables: export OMP_NUM_THREADS = 1
slow-tables: export IGL_NUM_THREADS = 1
slow-tables:
	$(if $(filter data/embedded,$(DATA)),$(BIN)/stable-data synth runs/evaluate/held_out --scenes 200 --seed 7 --no-pictures)
	$(if $(filter data/embedded,$(DATA)),$(BIN)/python -m pipelines preprocess --data runs/evaluate/held_out --out $(HELD_OUT))
	$(BIN)/python -m benchmarks.rearrangement $(HELD_OUT) --lego-steps 25 --diffusion-steps 50 --out runs/evaluate/rearrangement --json runs/evaluate/rearrangement.json
	$(BIN)/python -m benchmarks.generalisation $(DATA) --scenes 20 --json runs/evaluate/generalisation.json
	$(if $(filter data/embedded,$(DATA)),$(BIN)/python -m benchmarks.edits --file benchmarks/edit_requests/unseen_synth.jsonl --scenes $(DATA) --json runs/evaluate/edits.json)
	$(BIN)/python -m benchmarks.corrector_ablation runs/evaluate/data --out runs/evaluate/ablation --arm full --arm "no support" --arm "no table" --arm "no objects" --json runs/evaluate/corrector_ablation.json

bench: $(READY) $(if $(filter data/embedded,$(DATA)),data/embedded) ## Side-by-side figures against peers (DATA=<folder with real meshes>)
	$(BIN)/python -m benchmarks --data $(DATA) --out runs/bench

consumers: ## NAME=<usd, simready, robotics, robosuite, lerobot, fid, croissant> (default: all): environments of other people's programs, in .consumers, for tests of exports
	@for name in $(or $(NAME),$(basename $(notdir $(wildcard benchmarks/consumers/requirements/*.txt)))); do \
	  $(PYTHON) -m venv .consumers/$$name && .consumers/$$name/bin/python -m pip install -q --disable-pip-version-check -r benchmarks/consumers/requirements/$$name.txt || exit 1; \
	done

$(VENV)/.docs: $(READY)
	$(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

docs: $(VENV)/.docs ## Build the documentation site in build/docs; a broken link or reference is an error
	$(BIN)/python -m sphinx -q -W --keep-going -d build/doctrees docs build/docs
	@echo "open build/docs/index.html"

# Programs of a release, in an environment of their own.
$(TOOLS)/.ready: constraints.txt
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt build cyclonedx-bom twine
	touch $@

wheel: $(TOOLS)/.ready ## Build the wheel and the sdist of the light library in build/dist, and check what they say of themselves
	rm -rf build/dist
	$(TOOLS)/bin/python -m build --outdir build/dist
	$(TOOLS)/bin/twine check --strict build/dist/*

test-wheel: $(READY) ## Install the wheel in an empty environment without a compiler: load a run, lint, export (what CI runs)
	$(BIN)/python -m pytest -m slow -k library_alone tests/test_wheel.py

# What constraints.txt does not pin has the version of .venv, as the tests ran with it. pysdf has no wheel: it has a file of its own, and what
# its build needs is with the others.
LOCKED_EXTRAS := $(filter-out pysdf,$(subst $(COMMA), ,$(EXTRAS))) cluster docs
UV_COMPILE = $(BIN)/uv pip compile --python-version 3.11 --generate-hashes --no-annotate -c constraints.txt --custom-compile-command 'make lock' --quiet
lock: $(READY) ## Write requirements.lock from constraints.txt: the version and the hashes of every package of make env
	mkdir -p build
	printf 'cmeel-eigen\npybind11\nsetuptools\n' > build/of_source.in
	echo pysdf > build/source.in
	$(BIN)/python -m pip freeze --exclude-editable | sed 's/+cpu$$//' > build/installed.txt
	$(UV_COMPILE) pyproject.toml build/of_source.in $(addprefix --extra ,$(LOCKED_EXTRAS)) --universal -c build/installed.txt -o requirements.lock
	$(UV_COMPILE) build/source.in --no-deps -o requirements-source.lock

sbom: $(READY) $(TOOLS)/.ready ## LOCKED=1 for a release: write the software bill of materials of .venv to build/sbom.cdx.json (CycloneDX)
	$(TOOLS)/bin/cyclonedx-py environment --pyproject pyproject.toml --mc-type library --output-reproducible --validate \
	  --output-file build/sbom.cdx.json $(BIN)/python

clean: ## Remove the environment and what was generated
	rm -rf $(VENV) .consumers build docs/api *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis data/embedded runs
