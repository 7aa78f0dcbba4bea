## make scene=demo all            the whole job; a second call finds everything cached
## make scene=X STAGE             one stage and what it needs: the stages of pipeline.yaml
## make scene=X plan              what would run, why, and how long; gpu=rtx-4090: on that GPU
## make app [scene=X]             one page from photographs to the finished scene, in a browser; port=8090
## make scene=X mask              make masks from clicks, in a browser; port=8090
## make scene=X check             look for problems of photographs, masks and poses; draw each mask over its photograph
## make scene=X compare           the full method, ablations and baselines: runs/X/compare.html
##                                variants=a,b: only these; seeds=5: on demo, demo-1 ... demo-4, with intervals
## make data=FOLDER compare       the same on all its scenes, in one table: runs/compare/compare.html
## make scene=X report            what was done, errors against time: runs/X/report.html
## make data=FOLDER report        the same of all its scenes: runs/report/index.html
## make scene=X view              walk through the finished scene in a browser; port=8080
## make scene=X turntable         a video around the finished scene: runs/X/turntable.webm
## make scene=X patch             fill what was deleted in an editor (scene.yaml: gaussians, cleaned): runs/X/patch/
##                                with two files only: reffusion patch before.ply after.ply --out patched.ply
## make scene=X export            the finished scene for other tools, .ply, .spz, .glb, cameras, LoRA: runs/X/export/
##                                sog=1: .sog and .html, too, by Node's npm
## make scene=X verify            hash all its results: are they as they were made?
## make scene=X clean             remove its results
## make gc                        list results that no plan uses, with sizes; remove them if you say so, or with yes=1
## make data=FOLDER batch         all scenes of a folder, in parallel: runs/results.html; cores=2: for each stage
##                                engine=ray address=HOST:6379, engine=slurm address=PARTITION: on a cluster
##                                (also for compare, all and stages)
## make data=FOLDER spinnerf      list SPIn-NeRF's published scenes in a folder, then batch
## make data=FOLDER study         after compare, or with scene=X: paired clips for people to judge
## make weights [profile=paper]   fetch the weights of a profile; offline=1: only list what is missing;
##                                painter=moebius: those of this painter too
## make doctor                    let each inpainter on this machine fill one hole: time, memory, runs/doctor.png
## make demo [seed=N]             make the demo scene, or data/demo-N; others are made when they are named: demo-wide,
##                                -360, -seen, -photos, -behind, -beside, -around, -table, -corner, -grass, -insert, -outpaint,
##                                -mono, -pair, -past, -sparse, each also with -N
## make scene=X adapted           views painted by the adapted prior and the unadapted one: runs/X/adapted/sheet.png
## make scene=X sds-variance      variance of the SDS gradient before and after personalization
##                                both: device=cuda dtype=float16
## make scene=demo-sparse sparse  scores against the number of photographs (hours); seeds=3: on two more scenes
## make gpu                       on a CUDA machine: install gsplat and build its extension (minutes, once);
##                                cuda=12: with the last torch for CUDA 12, for older drivers
## make gpu-check                 values, time and memory at the paper's sizes on a CUDA machine (1 to 8 minutes)
## make prior [steps=N]           train the embedded prior further (hours)
## make prior-report              measure the embedded prior (minutes): runs/prior-report
## make setup | test | lint       .venv; the tests, with slow=1 the slow ones too (make fuzz: hours); ruff and mypy
## make docs                      the documents as a site: build/site
## make test-fast                 the tests that start no processes and train nothing (five minutes)
## make bench                     work-precision diagrams of the kernels: runs/bench; gate=1: against the baselines
## make stability                 stiff and extreme cases, each with its bound (minutes): runs/stability.json
##
## scene=  a name under data/, or a path
## profile=auto|laptop|laptop-terms|paper|best|fast|paper-terms  variant=NAME  set="fit.iterations=500 distill.seed=3"  runs=FOLDER
## budget=5m  time for the whole job: sets the number of steps of fit, personalize and distill
## trust=1  accept results of older code; keep=1  accept results that you changed by hand

# The options. They are set here so that variables of the environment are ignored. Recipes read them as shell variables
# in double quotes, so that neither the shell nor make expands what was typed.
given := scene profile variant budget set trust keep runs variants seeds seed name steps gate slow offline painter port gpu \
	device dtype engine address cores yes cuda sog
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
STAGES := $(shell sed -n '/^stages:/,/^[a-z]/s/^  \([a-z_]*\):.*/\1/p' pipeline.yaml)

# $(call flags,a b) is `--a="$a" --b="$b"`, without those that were not given. Their meaning is in `reffusion`.
switches := trust keep yes offline sog
flags = $(foreach each,$1,$(if $($(each)),--$(each)$(if $(filter $(each),$(switches)),,="$$$(each)")))
where := scene variant runs
options := $(where) profile budget set trust keep
cluster := engine address cores

.PHONY: help setup named ready all $(STAGES) plan check compare report study app mask view turntable patch export verify \
	clean gc spinnerf batch weights doctor demo prior prior-report sds-variance adapted sparse test test-fast fuzz bench stability \
	gpu gpu-check lint docs
.DELETE_ON_ERROR:

help:
	@sed -n 's/^## \{0,1\}//p' Makefile

# ---------------------------------------------------------------------------------------------------- environment

setup: $(VENV)/.ready

# pip leaves bytecode to the first import. Where Python writes none, pip must: else each stage compiles its libraries.
bytecode := $(if $(PYTHONDONTWRITEBYTECODE),,--no-compile)

# An existing environment is never emptied.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'error: $(PYTHON) is not Python 3.11 or later; name one: make PYTHON=python3.12 setup' >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -f $@; exit 1; }

# The versions that are installed: those of constraints.txt, or after `make gpu cuda=12` those with another torch.
pins := $(if $(cuda),$(VENV)/constraints.txt,$(firstword $(wildcard $(VENV)/constraints.txt) constraints.txt))
# PyPI's last torch for CUDA 12, which driver 525 runs.
CUDA12_TORCH := 2.10.0
$(VENV)/constraints.txt: constraints.txt | $(VENV)/bin/python
	@test "$${cuda:-12}" = 12 || { echo "error: cuda=$$cuda: 12, or nothing for the torch of constraints.txt" >&2; exit 2; }
	@sed 's/^torch==.*/torch==$(CUDA12_TORCH)/' $< > $@

$(VENV)/.ready: pyproject.toml $(pins) | $(VENV)/bin/python
	$(PY) -m pip install --quiet $(bytecode) --constraint $(pins) --editable .
	@touch $@

# With an extra of pyproject.toml: view, export, cluster, dev.
$(VENV)/.ready-%: $(VENV)/.ready
	$(PY) -m pip install --quiet $(bytecode) --constraint $(pins) --editable '.[$*]'
	@touch $@

# Once, whether it succeeds or not: `make weights` tries again.
$(VENV)/.lpips: | $(VENV)/.ready
	@$(PY) -m reffusion.weights
	@touch $@

# --------------------------------------------------------------------------------------------------------- scenes

# Generated scenes: `demo` and `demo-<kind>`, with or without `-<seed>`.
kinds := photos wide mono 360 beside around past seen behind table corner grass insert outpaint pair sparse
# Their names are parts of recipes, so that they may have these characters only.
plain := a b c d e f g h i j k l m n o p q r s t u v w x y z 0 1 2 3 4 5 6 7 8 9 -
rest = $(if $1,$(call rest,$(wordlist 2,99,$1),$(subst $(firstword $1),,$2)),$2)
made := $(if $(call rest,$(plain),$(scene)),,$(filter demo demo-%,$(scene)))

demo: setup
	@out="data/$${name:-demo$${seed:+-$$seed}}" && \
		$(PY) -m lab.scenes.generate --out="$$out" --seed="$${seed:-0}" && touch "$$out/.generated"

data/%/.generated: | $(VENV)/.ready
	$(strip $(PY) -m lab.scenes.generate --out data/$* $(patsubst %,--kind %,$(filter $(kinds),$(subst -, ,$*))) \
		$(patsubst %,--seed %,$(filter-out demo $(kinds),$(subst -, ,$*))))
	@touch $@

# ----------------------------------------------------------------------------------------------------------- jobs

named:
	@test -n "$$scene" || { echo "error: which scene? For example: make scene=demo $$goals" >&2; exit 2; }

ready: named setup $(VENV)/.lpips $(if $(engine),$(VENV)/.ready-cluster) $(made:%=data/%/.generated)

all $(STAGES): ready
	@$(RUN) run $@ $(call flags,$(options) $(cluster))

plan: ready
	@$(RUN) plan $(call flags,$(options) gpu)

check: ready
	@$(RUN) run raw_masks $(call flags,$(options))
	@$(RUN) check $(call flags,$(where))

# The demo scenes of other seeds, too.
others := $(if $(call rest,0 1 2 3 4 5 6 7 8 9,$(seeds)),,$(if $(made),$(addsuffix /.generated,\
	$(addprefix data/$(made)-,$(wordlist 2,$(or $(seeds),1),$(shell seq 0 99))))))
# A scene, or all scenes of a folder.
these = $(if $(scene),--scene="$$scene",--data="$$data")
compare: $(if $(scene),ready $(others),$(if $(folder),setup $(if $(engine),$(VENV)/.ready-cluster),named))
	@$(RUN) compare $(these) $(call flags,$(filter-out scene,$(options)) $(cluster) variants seeds)

report: $(if $(scene),ready,setup)
	$(if $(scene),@$(RUN) plan --record $(call flags,$(options)))
	@$(RUN) report $(these) $(call flags,variant runs)

study: setup
	@$(RUN) study $(these) $(call flags,runs variants seed)

app: $(if $(scene),ready,setup $(VENV)/.lpips) $(VENV)/.ready-view $(VENV)/.ready-export
	@$(RUN) app $(call flags,scene runs port)

mask: ready $(VENV)/.ready-view $(VENV)/.ready-export
	@$(RUN) mask $(call flags,$(where) profile budget set port)

view: named $(VENV)/.ready-view
	@$(RUN) view $(call flags,$(where) port)

turntable: named setup
	@$(RUN) turntable $(call flags,$(where))

# What was deleted is known after `poses`: checked before the work.
patch: ready $(VENV)/.ready-export
	@$(RUN) run poses $(call flags,$(options))
	@$(RUN) patch --only-check $(call flags,$(where))
	@$(RUN) run all $(call flags,$(options))
	@$(RUN) patch $(call flags,$(where))

export: ready $(VENV)/.ready-export
	@$(RUN) run all $(call flags,$(options))
	@$(RUN) export $(call flags,$(where) sog)

verify clean: named setup
	@$(RUN) $@ $(call flags,$(options))

gc: setup
	@$(RUN) gc $(call flags,$(options) yes)

spinnerf batch: setup $(if $(engine),$(VENV)/.ready-cluster)
	$(if $(filter spinnerf,$@),@$(PY) -m lab.scenes.list_spinnerf --data="$$data")
	@$(RUN) batch --data="$$data" $(call flags,$(filter-out scene,$(options)) $(cluster))

doctor: setup
	@$(RUN) doctor

weights: setup
	@$(RUN) weights $(call flags,$(filter-out set,$(options)) offline) \
		--set="$$set$(if $(painter), reference.inpainter=$$painter)"

prior: runs/prior/photographs runs/prior/rooms
	$(PY) -m lab.prior.train --start priors/tiny --photographs runs/prior/photographs --rooms runs/prior/rooms $(call flags,steps)

runs/prior/rooms: | setup
	$(PY) -m lab.prior.rooms $@

runs/prior/photographs: | setup
	$(PY) -m lab.prior.photographs $@

# Personalizes on the reference of the demo scene, which is made first where it is missing.
prior-report: data/demo/.generated setup
	@$(RUN) run reference --scene demo --profile laptop
	$(PY) -m lab.studies.prior --start 0.35 --steps 1 4 12 --run runs/demo --out runs/prior-report
	$(PY) -m lab.studies.prior_page runs/prior-report

# Runs personalization and initialization first, where they are missing.
sds-variance: ready
	@$(RUN) run personalize $(call flags,$(options)) --set="distill.sds.run=always $$set"
	@$(RUN) run initialize $(call flags,$(options))
	$(PY) -m lab.studies.sds_variance --run="$${runs:-runs}/$$(basename "$$scene")" $(call flags,device dtype)

adapted: ready
	@$(RUN) run personalize $(call flags,$(options)) --set="distill.sds.run=always $$set"
	$(PY) -m lab.studies.adapted --run="$${runs:-runs}/$$(basename "$$scene")" $(call flags,device dtype steps)

# On the generated scene demo-sparse, with seeds=3 on two others, too (hours).
sparse: ready $(others)
	$(PY) -m lab.studies.sparse --scenes data/$(made) $(patsubst %/.generated,%,$(others)) \
		--out="$${runs:-runs}/sparse"

# Three processes with one thread each, since many tests wait for others that they start. Each gets whole files, so that
# tests of a file share compiled kernels.
test test-fast: $(VENV)/.ready-dev
	$(if $(slow),REFFUSION_SLOW=1) OMP_NUM_THREADS=1 $(PY) -m pytest --numprocesses 3 --dist loadfile \
		--no-loadscope-reorder $(if $(filter test-fast,$@),-m "not integration")

# Every reader on damaged files, ten minutes each.
fuzz: $(VENV)/.ready-dev
	$(PY) -m tests.test_fuzz

lint: $(VENV)/.ready-dev
	$(PY) -m ruff check .
	@$(PY) -m ruff check --quiet --exit-zero --select PLR0915,C901 . # long functions are warnings
	$(PY) -m ruff format --check --quiet .
	$(PY) -m mypy

bench: $(VENV)/.ready
	$(PY) -m lab.bench --out="$${runs:-runs}/bench" $(if $(gate),--gate)

stability: $(VENV)/.ready-dev
	$(PY) -m lab.stability --out="$${runs:-runs}/stability.json"

# Checks first what an installation cannot fix. MAX_JOBS limits the number of compilers, which take up to 1 GB each.
gpu: $(VENV)/.ready
	@$(PY) -m lab.gpu.ready --before
	$(PY) -m pip install --quiet $(bytecode) --constraint $(pins) --editable '.[gpu]'
	@$(PY) -m lab.gpu.ready

gpu-check: $(VENV)/.ready
	$(PY) -m lab.gpu.check --out="$${runs:-runs}/gpu-check"

# The documents as a site in build/site. They are copied with their paths, so that links between them hold.
documents := $(wildcard *.md docs/*.md docs/images/* data/*.md priors/tiny/*.md plugins/nerfbaselines/*.md)
docs: $(VENV)/.ready-docs
	@rm -rf build/docs && mkdir -p build/docs && cp --parents LICENSE $(documents) build/docs
	PYTHONPATH=. $(VENV)/bin/zensical build --strict --clean
