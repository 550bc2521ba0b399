# `make` lists all targets. Nothing outside this folder is changed.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
# All targets share the virtual environment, and what takes long uses all processors anyway: -j changes nothing.
.NOTPARALLEL:

PYTHON ?= python3
SET ?= tested
PIP_FLAGS ?=
TORCH ?=
PYTEST_FLAGS ?=
BENCH_FLAGS ?=
CAMERAS_FLAGS ?=
TRACKING_FLAGS ?=
FAMILIES_FLAGS ?=
MASKS_FLAGS ?=
PRECISIONS_FLAGS ?=
CONSOLE_FLAGS ?=
RECORDINGS_FLAGS ?=
SOAK_FLAGS ?=
FUZZ_FLAGS ?=
MUTANTS ?= *__mutmut_7
MATRIX ?= 3.10-tested 3.11-tested 3.12-tested 3.13-tested 3.12-apt 3.12-kilted
TAG ?=
RELEASE_PYTHONS ?=

ifeq ($(SET),tested)
VENV := .venv
CONSTRAINTS := requirements/constraints.txt
else ifeq ($(SET),apt)
VENV := .venv-apt
CONSTRAINTS := requirements/constraints-apt.txt
else ifeq ($(SET),kilted)
VENV := .venv-kilted
CONSTRAINTS := requirements/constraints-kilted.txt
SET_REQUIREMENTS := -r requirements/kilted.txt
else
$(error SET=$(SET): expected 'tested' (the newest numpy, scipy and OpenCV), 'apt' (those of Ubuntu 24.04) or 'kilted' (ROS 2 Kilted))
endif
PINS := $(CONSTRAINTS) $(addprefix requirements/,$(shell sed -n 's/^-c //p' $(CONSTRAINTS)))
# VENV=.venv-NAME keeps another environment beside this one. No other folder is accepted, because make deletes it.
ifneq ($(words $(VENV)) $(findstring /,$(VENV)) $(patsubst .venv-%,.venv,$(VENV)),1  .venv)
$(error VENV=$(VENV): expected a folder here whose name begins with .venv-, such as .venv-3.12)
endif

ifneq ($(filter-out cpu cuda,$(TORCH)),)
$(error TORCH=$(TORCH): expected 'cpu' (the CPU build of torch), 'cuda' (the usual build of pip), or nothing for the one \
  that fits this machine)
endif
# PyTorch's own index of CPU builds, from its installation page; only torch itself is installed from there.
TORCH_INDEX := https://download.pytorch.org/whl/cpu

# Only the virtual environment counts: paths of a sourced ROS or of another environment would mix two builds of rclpy.
FOREIGN := PYTHONPATH PYTHONHOME LD_LIBRARY_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH RMW_IMPLEMENTATION \
  _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport $(FOREIGN) VIRTUAL_ENV ROS_LOCALHOST_ONLY ROS_STATIC_PEERS
# The first would have pip install elsewhere than into the virtual environment; the others change what Python does.
unexport PIP_USER PIP_TARGET PIP_PREFIX PIP_ROOT PIP_PYTHON PYTHONSAFEPATH PYTHONOPTIMIZE PYTHONWARNINGS
# The tests start hundreds of Python processes: without cached bytecode each compiles this package again.
unexport PYTHONDONTWRITEBYTECODE
export AMENT_PREFIX_PATH := $(abspath $(VENV))
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export PATH := $(abspath $(VENV))/bin:$(PATH)

# Resolved now: the recipes search the virtual environment first, and its own Python is deleted when it is recreated.
override PYTHON := $(or $(shell PATH="$${PATH//'$(abspath $(VENV))/bin:'/}"; command -v "$(PYTHON)"),$(PYTHON))

# A stamp is written only after its step has succeeded: an interrupted step is repeated from the beginning.
# The first stamp has Python's version in its name, so another PYTHON creates a new environment.
PYTHON_VERSION := $(shell "$(PYTHON)" -I -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
DEPENDENCIES := $(VENV)/.dependencies-$(PYTHON_VERSION)
INTERFACES := $(VENV)/.interfaces
PACKAGE := $(VENV)/.package
TESTS := $(VENV)/.tests
FUZZER := $(VENV)/.fuzzer
MUTATOR := $(VENV)/.mutator
RELEASER := $(VENV)/.releaser
INTERFACES_BUILD := build/interfaces$(patsubst .venv%,%,$(VENV))
SITE_VENV := build/site-venv
WORKFLOW_VENV := build/workflow-venv
INTERFACE_PACKAGES := vision_msgs bond
# The compiled messages of a release for this Python, if build/dist has them and no file in interfaces/ is newer; they fit
# the tested ROS distribution only.
VERSION := $(shell sed -n 's:.*<version>\(.*\)</version>.*:\1:p' package.xml)
RELEASED := $(wildcard build/dist/yolov5_lifecycle_interfaces-$(VERSION)-cp$(subst .,,$(PYTHON_VERSION))-*_$(shell uname -m).whl)
RELEASED := $(if $(filter tested apt,$(SET)),$(if $(RELEASED),$(if $(shell find interfaces -type f -newer $(RELEASED)),,$(RELEASED))))
INTERFACES_WHEEL ?= $(RELEASED)
ACTIVATION := unset $(FOREIGN); export AMENT_PREFIX_PATH="$$VIRTUAL_ENV"
# As many processes as the machine has room for; each file of tests is run by one of them.
PYTEST := $(VENV)/bin/python -m pytest -n auto --dist loadfile
PATIENT := -o timeout=600 -o faulthandler_timeout=700
DEMO_FOLDER = mkdir -p build/demo && test -w build/demo || { \
  echo 'Run "$(abspath $(VENV))/bin/demo" in a folder of your own: this user cannot write to build/demo.' >&2; exit 1; }
TYPED := $(wildcard yolov5_lifecycle test soak fuzz tools benchmark launch requirements)

.PHONY: help install demo demo-cameras console test test-end-to-end test-all test-matrix coverage soak fuzz mutants bench bench-families lint docs docs-site workflows clean
.PHONY: release-check package interfaces-wheels release-versions release-metadata release-reproducible release-install
help:
	@echo 'make demo     camera and detector as two processes, driven through their services; result in build/demo'
	@echo 'make demo-cameras  two cameras on one detector, with tracks and places in space; result in build/demo'
	@echo 'make console  camera, detector and console together until Ctrl-C; prints the address for the browser'
	@echo '              (CONSOLE_FLAGS="--port 8090")'
	@echo 'make test     the tests, without the long ones  (SET=apt: numpy, scipy, OpenCV of Ubuntu 24.04, in .venv-apt)'
	@echo '              (SET=kilted: ROS 2 Kilted instead of Jazzy, in .venv-kilted)'
	@echo 'make test-end-to-end  the ways of a user from the start to the end: demo, every command, the page in a browser'
	@echo 'make test-all all tests'
	@echo 'make test-matrix  make test with every supported Python and SET, as far as this machine has the Pythons'
	@echo 'make coverage all tests, with the line coverage of the package, child processes included'
	@echo 'make bench    how fast each runtime is, quiet and beside a busy process, and how well objects are tracked'
	@echo '              and what several cameras on one node, masks and many recordings cost, and what int8 saves'
	@echo '              (BENCH_FLAGS="--quick"  CAMERAS_FLAGS="--quick"  TRACKING_FLAGS="--seeds 1")'
	@echo 'make bench-families  the forward pass of every family of models beside eager torch (FAMILIES_FLAGS="--quick")'
	@echo 'make soak     hours of hostile clients, faults and signals; table, and build/soak/report.json'
	@echo 'make fuzz     coverage-guided fuzzing of what reads images, weights, labels and recordings'
	@echo 'make mutants  changes the code in small ways, which a test must notice  (MUTANTS="yolov5_lifecycle.tracking.*")'
	@echo 'make release-check  builds a release of the last commit into build/dist and checks it: docs/releasing.md'
	@echo 'make interfaces-wheels  only the compiled messages  (RELEASE_PYTHONS="python3.11 python3.12")'
	@echo 'make lint     ruff and mypy --strict'
	@echo 'make install  .venv with all pinned packages, messages and this package, as for the tests; the demo needs half of them'
	@echo 'make docs     regenerates what is derived from the settings: YAML file, schema, reference page'
	@echo 'make docs-site  the pages as a site with a search, in build/site; fails for a link that leads nowhere'
	@echo 'make workflows  actionlint on .github/workflows'
	@echo 'make clean    removes everything that make has created, .venv included'
	@echo 'Variables: PYTHON=python3.12  SET=apt|kilted  TORCH=cpu|cuda  PIP_FLAGS="..."  PYTEST_FLAGS="-k name"  SOAK_FLAGS="--minutes 5"'

install: $(TESTS)

demo: $(PACKAGE)
	@$(DEMO_FOLDER)
	@XDG_CACHE_HOME="$(abspath build/cache)" $(VENV)/bin/demo

demo-cameras: $(PACKAGE)
	@$(DEMO_FOLDER)
	@XDG_CACHE_HOME="$(abspath build/cache)" $(VENV)/bin/demo --cameras

console: $(PACKAGE)
	@$(DEMO_FOLDER)
	@XDG_CACHE_HOME="$(abspath build/cache)" $(VENV)/bin/demo --console $(CONSOLE_FLAGS)

test: $(TESTS)
	$(PYTEST) -m 'not long and not end_to_end' $(PYTEST_FLAGS)

test-end-to-end: $(TESTS)
	$(PYTEST) -m end_to_end $(PYTEST_FLAGS)

test-all: $(TESTS)
	$(PYTEST) $(PATIENT) $(PYTEST_FLAGS)

# The folder of each environment stays, so a repeated run installs nothing; .venv is for the Python of `make` alone.
test-matrix:
	@outcomes=; status=0; for each in $(MATRIX); do \
	  version=$${each%%-*}; set=$${each#*-}; folder=; \
	  [ $$each = $(PYTHON_VERSION)-tested ] || [ $$set != tested ] || folder=VENV=.venv-$$version; \
	  if ! python=$$(PATH="$${PATH//'$(abspath $(VENV))/bin:'/}" .ci/find-python $$version); then outcome="left out"; \
	  elif $(MAKE) --no-print-directory test PYTHON="$$python" SET=$$set $$folder; then outcome=passed; \
	  else outcome=failed; status=1; fi; \
	  outcomes+="$$each: $$outcome"$$'\n'; done; \
	echo "$$outcomes"; [[ $$outcomes = *passed* ]] && exit $$status

coverage: $(TESTS)
	rm -rf build/coverage
	$(VENV)/bin/coverage run -m pytest $(PATIENT) $(PYTEST_FLAGS)
	$(VENV)/bin/coverage combine --quiet
	$(VENV)/bin/coverage report

bench: $(TESTS)
	$(VENV)/bin/python -m benchmark.bench $(BENCH_FLAGS)
	$(VENV)/bin/python -m benchmark.cameras $(CAMERAS_FLAGS)
	$(VENV)/bin/python -m benchmark.collecting $(COLLECTING_FLAGS)
	$(VENV)/bin/python -m benchmark.collected_errors $(COLLECTED_ERRORS_FLAGS)
	$(VENV)/bin/python -m benchmark.tracking $(TRACKING_FLAGS)
	$(VENV)/bin/python -m benchmark.masks $(MASKS_FLAGS)
	$(VENV)/bin/python -m benchmark.precisions $(PRECISIONS_FLAGS)
	PYTHONPATH=test $(VENV)/bin/python -m benchmark.recordings $(RECORDINGS_FLAGS)

bench-families: $(TESTS)
	PYTHONPATH=test $(VENV)/bin/python -m benchmark.families $(FAMILIES_FLAGS)

# It drives the detector with the tools in test/support.
soak: $(TESTS)
	PYTHONPATH=test XDG_CACHE_HOME="$(abspath build/cache)" $(VENV)/bin/python -m soak $(SOAK_FLAGS)

# It attacks the readers with files built by the tools in test/support.
fuzz: $(TESTS) $(FUZZER)
	PYTHONPATH=test $(VENV)/bin/python -m fuzz $(FUZZ_FLAGS)

# What is changed, and which tests must notice it, stands in pyproject.toml.
mutants: $(TESTS) $(MUTATOR)
	$(VENV)/bin/python -m mutmut run '$(MUTANTS)'
	$(VENV)/bin/python -m mutmut results | sed '/: not checked$$/d'

lint: $(TESTS)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy --strict $(TYPED)

docs: $(TESTS)
	$(VENV)/bin/python -m tools.settings_documents

# What `make release-check` does, in this order; a further check is one more target in this list.
RELEASE_STEPS := release-versions package interfaces-wheels release-metadata release-reproducible release-install docs-site

release-check:
	for step in $(RELEASE_STEPS); do $(MAKE) --no-print-directory $$step; done

release-versions: $(PACKAGE)
	$(VENV)/bin/python -m tools.release versions $(TAG)

package: $(PACKAGE) $(RELEASER)
	$(VENV)/bin/python -m tools.release package

interfaces-wheels: $(PACKAGE) $(RELEASER)
	$(VENV)/bin/python -m tools.release interfaces $(RELEASE_PYTHONS)

release-metadata: $(PACKAGE) $(RELEASER)
	$(VENV)/bin/python -m twine check --strict build/dist/*

release-reproducible: $(PACKAGE) $(RELEASER)
	$(VENV)/bin/python -m tools.release reproducible

release-install: $(TESTS)
	RELEASE_WHEELS=$(abspath build/dist) $(PYTEST) test/test_installed_package.py

# Neither needs the package: each has an environment of its own.
docs-site: $(SITE_VENV)/.installed
	$(SITE_VENV)/bin/mkdocs build

workflows: $(WORKFLOW_VENV)/.installed
	$(WORKFLOW_VENV)/bin/actionlint

clean:
	rm -rf .venv .venv-* build install mutants log *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

# Python compiles what is imported; pip would compile all modules, which takes half a minute and 200 MB, mostly unused.
$(DEPENDENCIES): requirements/environment.txt requirements/interfaces.txt $(lastword $(SET_REQUIREMENTS)) $(PINS)
	@"$(PYTHON)" -c "" || { echo "PYTHON=$(PYTHON) does not run; name a Python 3.10 to 3.13" >&2; exit 1; }
	@"$(PYTHON)" requirements/check_machine.py $(SET) $(INTERFACES_WHEEL)
	@echo "Installing what the demo needs into $(VENV): some minutes the first time."
	rm -rf $(VENV)
	"$(PYTHON)" -m venv $(VENV)
	@$(VENV)/bin/python requirements/install_torch.py "$(TORCH)" $(TORCH_INDEX) -c $(CONSTRAINTS) $(PIP_FLAGS) --no-compile
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) --no-compile -r requirements/environment.txt $(SET_REQUIREMENTS) -c $(CONSTRAINTS)
	touch $(if $(TORCH),$(VENV)/.torch-$(TORCH)) $@

$(TESTS): $(DEPENDENCIES) requirements/tests.txt | $(PACKAGE)
	@echo "Installing the other packages into $(VENV): some minutes the first time."
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) -r requirements/tests.txt -c $(CONSTRAINTS)
	touch $@

$(INTERFACES): $(DEPENDENCIES) $(shell find interfaces -type f) $(INTERFACES_WHEEL)
	@echo "$(if $(INTERFACES_WHEEL),Installing $(INTERFACE_PACKAGES) from $(INTERFACES_WHEEL).,Building $(INTERFACE_PACKAGES) into $(VENV): about a minute.)"
	rm -rf $(INTERFACES_BUILD)
	mkdir -p build
	cp -r interfaces $(INTERFACES_BUILD)
	$(VENV)/bin/python -m pip install --no-index --no-build-isolation --force-reinstall --no-deps \
	  $(or $(INTERFACES_WHEEL),./$(INTERFACES_BUILD))
	touch $@

$(FUZZER): $(DEPENDENCIES) requirements/fuzz.txt
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) -r requirements/fuzz.txt -c $(CONSTRAINTS)
	touch $@

$(MUTATOR): $(DEPENDENCIES) requirements/mutants.txt
	@$(VENV)/bin/python -c 'import sys; sys.exit(sys.version_info < (3, 11) and "PYTHON=$(PYTHON): make mutants needs Python 3.11 or newer")'
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) -r requirements/mutants.txt -c $(CONSTRAINTS)
	touch $@

$(RELEASER): $(DEPENDENCIES) requirements/release.txt
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) -r requirements/release.txt -c $(CONSTRAINTS)
	touch $@

build/%-venv/.installed: requirements/%.txt requirements/pins.txt
	rm -rf $(@D)
	"$(PYTHON)" -m venv $(@D)
	$(@D)/bin/python -m pip install $(PIP_FLAGS) -r $< -c requirements/pins.txt
	touch $@

# Modules and data are used in place, so the package's share/ is this folder; colcon copies what setup.py names.
$(PACKAGE): $(INTERFACES) Makefile setup.py setup.cfg package.xml
	PYTHONWARNINGS=ignore $(VENV)/bin/python -m pip install --quiet --no-deps --no-index --no-build-isolation --editable .
	grep -qxF '$(ACTIVATION)' $(VENV)/bin/activate || echo '$(ACTIVATION)' >> $(VENV)/bin/activate
	ln -sfnT ../.. $(VENV)/share/yolov5_lifecycle
	ln -sfT ../../../../../resource/yolov5_lifecycle $(VENV)/share/ament_index/resource_index/packages/yolov5_lifecycle
	touch $@

# The environment has another build of torch than TORCH asks for: it is made anew.
ifneq ($(TORCH),)
ifeq ($(wildcard $(VENV)/.torch-$(TORCH)),)
.PHONY: $(DEPENDENCIES)
endif
endif
