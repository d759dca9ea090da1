# `make help` lists the targets. Without an active environment, one is made in .venv and used.
MODEL ?=
SCALE ?=
CHECKPOINT ?=
SWEEP ?=
ARGS ?=
ACTIVE := $(or $(VIRTUAL_ENV),$(CONDA_PREFIX))
PYTHON := $(if $(ACTIVE),python,.venv/bin/python)
# The stamp remembers an install: it is redone when pyproject.toml or constraints.txt changes. It lives inside the
# environment it describes.
STAMP := $(if $(ACTIVE),$(ACTIVE),.venv)/.horizon3d-installed
TEST_STAMP := $(STAMP)-tests
SCALE_ARG := $(if $(SCALE),scale=$(SCALE))
INIT_ARG := $(if $(CHECKPOINT),'phase.init_from="$(CHECKPOINT)"')
ifeq ($(MODEL),lrs4fusion)  # all its phases, one after the other, or the one that PHASE names
PHASES := $(if $(PHASE),lrs_$(PHASE),lrs_occupancy lrs_forecast lrs_detection)
$(if $(and $(CHECKPOINT),$(word 2,$(PHASES))),$(error CHECKPOINT=$(CHECKPOINT): say which PHASE begins from it))
else
PHASE ?= 1
PHASES := phase$(PHASE)
endif
$(if $(filter phase1 phase1_further phase2 lrs_occupancy lrs_forecast lrs_detection,$(PHASES)),,$(error PHASE=$(PHASE): must be 1, 1_further or 2, or with MODEL=lrs4fusion occupancy, forecast or detection))
MODEL_ARG := $(if $(MODEL),model=$(MODEL))

.PHONY: help install world train sweep study report dashboard benchmark performance test test-all test-faults audit gpu check
.DEFAULT_GOAL := help

help: ## show this list
	@awk -F':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# An active environment keeps the versions it has, so that a torch of one's choice stays.
PINNED := $(if $(ACTIVE),,--constraint constraints.txt)
$(STAMP): pyproject.toml constraints.txt
	$(if $(ACTIVE),,test -x .venv/bin/python || python3 -m venv .venv)
	$(PYTHON) -m pip install --quiet $(PINNED) --editable .
	@touch $@

$(TEST_STAMP): $(STAMP)
	$(PYTHON) -m pip install --quiet $(PINNED) --editable ".[test,oracle]"
	@touch $@

install: $(STAMP) ## create .venv (unless an environment is active) and install the project

world: $(STAMP) ## write the synthetic highway (preview: ARGS="preview=true")
	$(PYTHON) -m src.world $(SCALE_ARG) $(ARGS)

define TRAIN
$(PYTHON) -m src.train $(MODEL_ARG) phase=$(1) $(INIT_ARG) $(SCALE_ARG) $(ARGS)

endef
train: $(STAMP) ## train PHASE=1|1_further|2 [MODEL=lrs4fusion: all its phases] [CHECKPOINT=PATH] [SCALE=debug|mini|paper] [ARGS="seed=1 ..."]
	$(foreach phase,$(PHASES),$(call TRAIN,$(phase)))

sweep: $(STAMP) ## train every row of SWEEP=epsilon and write its tables [ARGS="seeds=3 workers=2 dry_run=true"]
	$(PYTHON) -m src.sweep +sweep=$(SWEEP) $(SCALE_ARG) $(ARGS)

study: $(STAMP) ## train the sweeps of the paper's claims and the others with three seeds, then more for claims that are open [ARGS="workers=2 dry_run=true"]
	$(PYTHON) -m src.study $(SCALE_ARG) $(ARGS)

report: $(STAMP) ## everything finished into reports/: results, tables, pages, dashboard.html; shows the page of PHASE
	$(PYTHON) -m src.report $(MODEL_ARG) phase=$(lastword $(PHASES)) $(SCALE_ARG) $(ARGS)

dashboard: $(STAMP) ## sweeps and runs in the browser, on this machine [ARGS="port=8000" or ARGS="export=FILE"]
	$(PYTHON) -m src.dashboard $(ARGS)

benchmark: $(STAMP) ## time and memory of every part [ARGS="suite=metric"]
	$(PYTHON) -m src.benchmark $(SCALE_ARG) $(ARGS)

# The pages of reports/performance; on a GPU they get names of their own.
FULL_SIZE := scale=paper data=synthetic_full
PRECISION := precision=32-true
performance: $(STAMP) ## all pages of reports/performance, an hour and a half of a quiet machine [on a GPU: PRECISION=precision=bf16-mixed]
	for suite in "suite=ops $(FULL_SIZE)" "suite=scaling phase=phase2 $(FULL_SIZE)" \
	    "suite=model phase=phase1 $(FULL_SIZE)" "suite=model phase=phase1 model=dense_bev $(FULL_SIZE)" \
	    "suite=model phase=phase2 model.dptf.bev_path.memory_threshold=0 $(FULL_SIZE)" \
	    "suite=model phase=phase2 model=dense_bev $(FULL_SIZE)" \
	    "suite=model model=lrs4fusion phase=lrs_occupancy model/roi=roi_official $(FULL_SIZE)" \
	    "suite=scaling model=lrs4fusion phase=lrs_occupancy $(FULL_SIZE)" \
	    "suite=launches phase=phase2 model.dptf.bev_path.memory_threshold=0 $(FULL_SIZE)" \
	    "suite=training" "suite=training model=dense_bev" "suite=reader $(FULL_SIZE)" "suite=reader" "suite=metric" \
	    "suite=soak phase=phase2"; do \
	    $(PYTHON) -m src.benchmark $$suite $(PRECISION) out=reports/performance $(ARGS) || exit 1; \
	done

# The kernels, the sanitizer on the smallest case, then the pages; what is late is ended, so that no more than an hour passes.
OTHERS := dense_bev crt_fusion hydra sparc petr far3d rctrans
gpu: $(TEST_STAMP) ## on a GPU, without data, in an hour: tests of the kernels, sanitizer, pages of reports/performance
	timeout 10m env $(PYTEST) -q -m gpu $(ARGS)
	if command -v compute-sanitizer; then timeout 5m compute-sanitizer --target-processes all --error-exitcode 1 \
	    $(PYTHON) -m pytest -q -m gpu tests/ops/kernels -k one_site || exit 1; fi
	failed=0; for suite in "150 suite=gpu phase=phase2 model.dptf.bev_path.memory_threshold=0" \
	    $(OTHERS:%="150 suite=gpu phase=phase2 model=%") "150 suite=gpu phase=phase1_further model=radargnn" \
	    "600 suite=scaling phase=phase2" "600 suite=ops"; do \
	    timeout $${suite%% *} $(PYTHON) -m src.benchmark $${suite#* } $(FULL_SIZE) \
	        precision=bf16-mixed trainer.accelerator=gpu out=reports/performance || failed=1; \
	done; exit $$failed

# One thread per process: small operators gain nothing from a second one, and side by side they slow each other down.
PYTEST := OMP_NUM_THREADS=1 $(PYTHON) -m pytest -n auto --dist loadfile

test: $(TEST_STAMP) ## run the tests, some minutes
	$(PYTEST) -m "not faults and not exhaustive" $(ARGS)

test-all: $(TEST_STAMP) ## run every test but the fault suite: every sweep, every option, long trainings
	$(PYTEST) -m "not faults" $(ARGS)

test-faults: $(TEST_STAMP) ## kill, starve and corrupt running commands, half an hour [ARGS="-k kills"]
	$(PYTEST) -m faults $(ARGS)

# In an environment of its own, so that it changes nothing of what it looks at. What cannot be looked up is a failure.
AUDITOR := $(dir $(STAMP)).audit
audit: $(STAMP) ## look the versions of constraints.txt up among known vulnerabilities, over the network
	test -x $(AUDITOR)/bin/pip-audit || { $(PYTHON) -m venv $(AUDITOR) && $(AUDITOR)/bin/pip install --quiet pip-audit; }
	$(AUDITOR)/bin/pip-audit --strict --requirement constraints.txt --no-deps --disable-pip $(ARGS)

check: $(TEST_STAMP) ## lint and the fast tests, a minute
	$(PYTHON) -m ruff check .
	$(PYTEST) -q -m "not slow and not gpu and not faults and not exhaustive" $(ARGS)
