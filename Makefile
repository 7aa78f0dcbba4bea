# One run: make scene=demo all        What it would do: make scene=demo plan        Everything else: make help

# Given on the command line; set here so that a variable of the environment is not taken for one of them. Recipes read
# them from their environment, in double quotes, as they were typed: there is no quote or $ that a shell or make obeys.
given := scene profile variant budget set trust keep runs variants seeds seed name steps gate slow offline port card device dtype engine address cores yes
$(foreach each,$(given),$(eval $(each) :=))
data := data
folder := $(findstring command,$(origin data))
$(foreach each,$(given) data,$(eval override $(each) := $$(value $(each))))
goals := $(value MAKECMDGOALS)
export $(given) data goals

# GOMP_SPINCOUNT: see reffusion/__init__.py
export GOMP_SPINCOUNT ?= 30000

PYTHON ?= python3
VENV ?= .venv
PY := $(VENV)/bin/python
RUN := $(VENV)/bin/reffusion
STAGES := poses raw_masks fit masks reference lift initialize personalize distill finish evaluate

of = --scene="$$scene"
where = $(if $(variant),--variant="$$variant") $(if $(runs),--runs="$$runs")
by = $(if $(engine),--engine="$$engine") $(if $(address),--address="$$address") $(if $(cores),--cores="$$cores")
options = $(where) $(if $(profile),--profile="$$profile") $(if $(budget),--budget="$$budget") \
	$(if $(set),--set="$$set") $(if $(trust),--trust) $(if $(keep),--keep)

.PHONY: help setup all $(STAGES) plan check verify clean batch spinnerf weights demo prior prior-report sds-variance \
	adapted view turntable test fuzz bench stability gpu gpu-check lint
.DELETE_ON_ERROR:

help:
	@echo 'make scene=demo all            the whole job; a second call finds everything cached'
	@echo 'make scene=X STAGE             one stage and what it needs: $(STAGES)'
	@echo 'make scene=X plan              what would run, and why; card=rtx-4090: and what each stage takes on that card'
	@echo 'make scene=X mask              masks from clicks, in a browser; port=8090'
	@echo 'make scene=X check             what is odd about its photographs, masks and poses; each mask over its photograph'
	@echo 'make scene=X compare           the full method, ablations and baselines side by side: runs/X/compare.html'
	@echo '                               variants=a,b  only these; seeds=5  on demo, demo-1 ... demo-4, with intervals'
	@echo 'make data=FOLDER compare       the same over all its scenes, in one table: runs/compare/compare.html'
	@echo 'make data=FOLDER spinnerf      what it holds of SPIn-NeRF'"'"'s published scenes; then as batch'
	@echo 'make data=FOLDER study         then, or with scene=X: paired clips for people to judge: runs/compare/study/index.html'
	@echo 'make scene=X report            what was done, errors against seconds: runs/X/report.html'
	@echo 'make scene=X view              walk through the finished scene in a browser; port=8080'
	@echo 'make scene=X turntable         the finished scene on a way around the capture: runs/X/turntable.webm'
	@echo 'make scene=X sds-variance      the SDS gradient over noise and timesteps, before and after personalization'
	@echo '                               device=cuda dtype=float16  for this and the next'
	@echo 'make scene=demo-sparse sparse  scores against the number of photographs; seeds=3  on two more scenes (hours)'
	@echo 'make scene=X adapted           views painted by the adapted prior, beside the unadapted: runs/X/adapted/sheet.png'
	@echo 'make data=FOLDER report        the same of all its scenes: runs/report/index.html'
	@echo 'make scene=X patch             fill what was deleted in an editor (scene.yaml: gaussians, cleaned): runs/X/patch/'
	@echo '                               two files are enough: reffusion patch before.ply after.ply --out patched.ply'
	@echo 'make scene=X export            the finished scene for other tools, .ply, cameras, LoRA: runs/X/export/'
	@echo 'make scene=X verify            hash all that was computed for it: is it as it was made?'
	@echo 'make scene=X clean             remove what was computed for it'
	@echo 'make gc                        what no plan uses any more, with sizes; then removes it, if you say so or yes=1'
	@echo 'make data=FOLDER batch         every scene of a folder, several at once, and one table: runs/results.html; cores=2  each'
	@echo '                               engine=ray address=HOST:6379  on a cluster; engine=slurm address=PARTITION; also for'
	@echo '                               compare, all and stages'
	@echo 'make demo [seed=N]             make the demo scene, or another: data/demo-N; others are made when named:'
	@echo '                               demo-wide, -360, -seen, -photos, -behind, -table, -corner, -grass, -insert, -outpaint, -pair, -sparse,'
	@echo '                               with -N too'
	@echo 'make prior [steps=N]           train the embedded prior further (hours)'
	@echo 'make weights [profile=paper]   fetch what a profile needs, sizes first; offline=1 only says what is missing'
	@echo 'make gpu                       on a CUDA machine: gsplat, and its extension built and loaded (minutes, once)'
	@echo 'make gpu-check                 values, time and memory at the paper'"'"'s sizes on a CUDA machine (1 to 8 minutes)'
	@echo 'make prior-report              measure it, and draw what it paints (minutes): runs/prior-report'
	@echo 'make setup | test | lint       .venv; the tests, slow=1 those that take minutes too (make fuzz: hours); ruff and mypy'
	@echo 'make bench                     work-precision diagrams of the kernels: runs/bench; gate=1: against the baselines'
	@echo 'make stability                 stiff and extreme cases, each with its bound (minutes): runs/stability.json'
	@echo 'scene=  a name under data/, or the path of any folder'
	@echo 'profile=auto|laptop|paper|best|paper-terms  variant=NAME  set="fit.iterations=500 distill.seed=3"  runs=FOLDER'
	@echo 'budget=5m  time for the whole job: sets the number of steps of fit, personalize and distill'
	@echo 'trust=1  keep results of older code; keep=1  and results that you changed by hand'

# ---------------------------------------------------------------------------------------------------- environment

setup: $(VENV)/.ready

# Bytecode is written by what is imported first; where Python is told not to, each stage would compile its libraries anew.
bytecode := $(if $(PYTHONDONTWRITEBYTECODE),,--no-compile)

# Only where there is none: an environment that exists is never emptied.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'error: $(PYTHON) is not Python 3.11 or later; name one: make PYTHON=python3.12 setup' >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -f $@; exit 1; }

$(VENV)/.ready: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PY) -m pip install --quiet $(bytecode) --constraint constraints.txt --editable .
	@touch $@

$(VENV)/.ready-view: $(VENV)/.ready
	$(PY) -m pip install --quiet $(bytecode) --constraint constraints.txt --editable '.[view]'
	@touch $@

$(VENV)/.ready-export: $(VENV)/.ready
	$(PY) -m pip install --quiet $(bytecode) --constraint constraints.txt --editable '.[export]'
	@touch $@

$(VENV)/.ready-cluster: $(VENV)/.ready
	$(PY) -m pip install --quiet $(bytecode) --constraint constraints.txt --editable '.[cluster]'
	@touch $@

# Once, and a failure too: `make weights` tries again.
$(VENV)/.lpips: | $(VENV)/.ready
	@$(PY) -m reffusion.weights
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready
	$(PY) -m pip install --quiet $(bytecode) --constraint constraints.txt --editable '.[dev]'
	@touch $@

# --------------------------------------------------------------------------------------------------------- scenes

# The demo scenes are made by the project: `demo`, `demo-photos` (no poses) and demo-<one of the others>, each with `-<seed>` or not.
kinds := photos wide 360 seen behind table corner grass insert outpaint pair sparse
# Their names become part of a recipe, so there are none with other characters than these.
plain := a b c d e f g h i j k l m n o p q r s t u v w x y z 0 1 2 3 4 5 6 7 8 9 -
rest = $(if $1,$(call rest,$(wordlist 2,99,$1),$(subst $(firstword $1),,$2)),$2)
made := $(if $(call rest,$(plain),$(scene)),,$(filter demo demo-%,$(scene)))

demo: setup
	@out="data/$${name:-demo$${seed:+-$$seed}}" && \
		$(PY) data/generate.py --out="$$out" --seed="$${seed:-0}" && touch "$$out/.generated"

data/%/.generated: | $(VENV)/.ready
	$(strip $(PY) data/generate.py --out data/$* $(patsubst %,--kind %,$(filter $(kinds),$(subst -, ,$*))) \
		$(patsubst %,--seed %,$(filter-out demo $(kinds),$(subst -, ,$*))))
	@touch $@

# ----------------------------------------------------------------------------------------------------------- jobs

.PHONY: named ready
named:
	@test -n "$$scene" || { echo "error: which scene? For example: make scene=demo $$goals" >&2; exit 2; }

ready: named setup $(VENV)/.lpips $(if $(engine),$(VENV)/.ready-cluster) $(made:%=data/%/.generated)

all $(STAGES): ready
	@$(RUN) run $@ $(of) $(options) $(by)

plan: ready
	@$(RUN) plan $(of) $(options) $(if $(card),--card="$$card")

check: ready
	@$(RUN) run raw_masks $(of) $(options)
	@$(RUN) check $(of) $(where)

.PHONY: compare report
# On the demo scenes of other seeds too. A variant that fails (3) stops no other: the table is drawn, then make fails.
others := $(if $(call rest,0 1 2 3 4 5 6 7 8 9,$(seeds)),,$(if $(made),$(addsuffix /.generated,\
	$(addprefix data/$(made)-,$(wordlist 2,$(or $(seeds),1),$(shell seq 0 99))))))
# Of a folder of scenes where it is named on the command line and no scene is.
these = $(if $(scene),$(of),--data="$$data")
compare: $(if $(scene),ready $(others),$(if $(folder),setup $(if $(engine),$(VENV)/.ready-cluster),named))
	@$(RUN) compare $(these) $(options) $(by) $(if $(variants),--variants="$$variants") $(if $(seeds),--seeds="$$seeds"); \
		status=$$?; test $$status = 0 || test $$status = 3 || exit $$status; \
		$(RUN) compare-page $(these) $(if $(runs),--runs="$$runs") && exit $$status

report: $(if $(scene),ready,setup)
ifneq ($(scene),)
	@$(RUN) plan --record $(of) $(options)
	@$(RUN) report $(of) $(where)
else
	@$(RUN) report --data="$$data" $(where)
endif

.PHONY: study
study: setup
	@$(RUN) study $(these) $(if $(runs),--runs="$$runs") $(if $(variants),--variants="$$variants") \
		$(if $(seed),--seed="$$seed")

.PHONY: mask
mask: ready
	@$(RUN) mask $(of) $(where) $(if $(profile),--profile="$$profile") $(if $(budget),--budget="$$budget") \
		$(if $(set),--set="$$set") $(if $(port),--port="$$port")

view: named $(VENV)/.ready-view
	@$(RUN) view $(of) $(where) $(if $(port),--port="$$port")

turntable: named setup
	@$(RUN) turntable $(of) $(where)

# What was deleted is known once `poses` has run: before the work, not after it.
.PHONY: patch export
patch: ready $(VENV)/.ready-export
	@$(RUN) run poses $(of) $(options)
	@$(RUN) patch $(of) $(where) --only-check
	@$(RUN) run all $(of) $(options)
	@$(RUN) patch $(of) $(where)

export: ready $(VENV)/.ready-export
	@$(RUN) run all $(of) $(options)
	@$(RUN) export $(of) $(where)

verify clean: named setup
	@$(RUN) $@ $(of) $(options)

.PHONY: gc
gc: setup
	@$(RUN) gc $(if $(scene),$(of)) $(options) $(if $(yes),--yes)

spinnerf: setup $(if $(engine),$(VENV)/.ready-cluster)
	@$(PY) data/spinnerf.py --data="$$data"
	@$(RUN) batch --data="$$data" $(options) $(by)

# A scene that fails (1) stops no other: the page is drawn, then make fails.
batch: setup $(if $(engine),$(VENV)/.ready-cluster)
	@$(RUN) batch --data="$$data" $(options) $(by); status=$$?; test $$status = 0 || test $$status = 1 || exit $$status; \
		$(RUN) batch-page $(where) && exit $$status

weights: setup
	@$(RUN) weights $(if $(scene),$(of)) $(if $(offline),--offline) $(options)

prior: setup
	$(PY) -m priors.tiny.train --start priors/tiny $(if $(steps),--steps="$$steps")

# Personalizes on the demo's reference, which is made first where it is missing.
prior-report: data/demo/.generated setup
	@$(RUN) run reference --scene demo --profile laptop
	$(PY) -m benchmarks.studies.prior --steps 1 4 12 --run runs/demo --out runs/prior-report
	$(PY) -m report.prior runs/prior-report

# On any scene; what it lacks of personalization and initialization is made first.
sds-variance: ready
	@$(RUN) run personalize $(of) $(options) --set="distill.sds.run=always $$set"
	@$(RUN) run initialize $(of) $(options)
	$(PY) -m benchmarks.studies.sds_variance --run="$${runs:-runs}/$$(basename "$$scene")" $(on)

# Where a study computes; what is made first runs where the profile says.
on = $(if $(device),--device="$$device") $(if $(dtype),--dtype="$$dtype")
adapted: ready
	@$(RUN) run personalize $(of) $(options) --set="distill.sds.run=always $$set"
	$(PY) -m benchmarks.studies.adapted --run="$${runs:-runs}/$$(basename "$$scene")" $(on) $(if $(steps),--steps="$$steps")

# Of a made scene demo-sparse, with seeds=3 of two others too: scores against the number of photographs (hours).
.PHONY: sparse
sparse: ready $(others)
	$(PY) -m benchmarks.studies.sparse --scenes data/$(made) $(patsubst %/.generated,%,$(others)) --out="$${runs:-runs}/sparse"

# Two processes of one thread each, whole files to each: kernels that are compiled for one test serve the next.
test: $(VENV)/.ready-dev
	$(if $(slow),REFFUSION_SLOW=1) OMP_NUM_THREADS=1 $(PY) -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

# Every reader on spoilt files, ten minutes each.
fuzz: $(VENV)/.ready-dev
	$(PY) -m tests.test_fuzz

lint: $(VENV)/.ready-dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check --quiet .
	$(PY) -m mypy

# slow=1 adds the splatting of 100,000 Gaussians and more, and personalization (an hour).
bench: $(VENV)/.ready
	$(PY) -m benchmarks.bench --out="$${runs:-runs}/bench" $(if $(gate),--gate) $(if $(slow),--slow)
	$(if $(slow),$(PY) -m benchmarks.bench.large)

stability: $(VENV)/.ready-dev
	$(PY) -m benchmarks.stability --out="$${runs:-runs}/stability.json"

# First what cannot be mended by installing; MAX_JOBS bounds the compilers, each of which takes up to 1 GB.
gpu: $(VENV)/.ready
	@$(PY) -m benchmarks.gpu.ready --before
	$(PY) -m pip install --quiet $(bytecode) --constraint constraints.txt --editable '.[gpu]'
	@$(PY) -m benchmarks.gpu.ready

gpu-check: $(VENV)/.ready
	$(PY) -m benchmarks.gpu.check --out="$${runs:-runs}/gpu-check"
