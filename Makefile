# Every target does its own set-up; all that it needs is Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
DEVELOPED := $(VENV)/.developed
EXTRAS := mapping,service,gem,s3,clients,compare,ros
# What is made last of it.
PAGE := service/page/built/report/report.js
PAGE_SOURCES := $(shell find web/src web/client/src web/*.html web/*.json web/client/*.json web/*.ts -type f)

.DEFAULT_GOAL := help
# Vite needs this much; without it the service has no page, and says so.
NODE_IS_THERE = command -v npm >/dev/null && node -e 'const [a, b] = process.versions.node.split(".").map(Number); process.exit(a > 22 || (a === 22 && b >= 12) || (a === 20 && b >= 19) ? 0 : 1)'
.PHONY: help install develop apart size licences-check page check-page browser balancer promtool demo test test-core test-extensions test-slow docs-check docs-errors docs-options licences lock sbom audit fuzz fuzz-api train-smoke bench bench-gpu bench-scale bench-change results trust fmt lint types contracts proto proto-check site docs-links check serve clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "%-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(INSTALLED) page ## make .venv to build, serve and localize, and the page where Node.js is

develop: $(DEVELOPED) page ## the same with what tests, checks and the docs need

$(DEVELOPED): EXTRAS := $(EXTRAS),cluster,tracing,dev
$(INSTALLED) $(DEVELOPED): pyproject.toml constraints.txt hatch_build.py $(wildcard visloc/matching/native/*.[ch])
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "visloc needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	@echo 'Installing into $(VENV): some minutes in which nothing is printed.' >&2
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[$(EXTRAS)]'
	touch $(INSTALLED) $@

page: ## build the page from web/
	@if $(NODE_IS_THERE); then $(MAKE) --no-print-directory $(PAGE); \
	else echo 'The page is not built: that takes npm and Node.js 20.19, 22.12 or newer.' >&2; fi

web/node_modules/.done: web/package.json web/package-lock.json
	npm ci --prefix web --ignore-scripts --no-audit --no-fund
	touch $@

$(PAGE): web/node_modules/.done $(PAGE_SOURCES)
	npm run --prefix web --silent build

# Tests of the page that find none are skipped, and say so: this never fails.
browser: page
	@if test -n "$$VISLOC_CHROMIUM" || command -v chromium >/dev/null \
		|| command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null; then :; \
	elif { $(NODE_IS_THERE); } && command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
		echo 'Installing Chromium for the tests of the page.' >&2; \
		apt-get update -qq >/dev/null 2>&1; \
		DEBIAN_FRONTEND=noninteractive apt-get install -qq --yes --no-install-recommends chromium \
			>/dev/null 2>&1 || echo 'It cannot be installed: those tests are skipped.' >&2; \
	else echo 'There is no Chromium, or no Node.js: the tests of the page are skipped.' >&2; fi

# As above: tests that find no HAProxy or kubectl are skipped.
balancer:
	@if command -v haproxy >/dev/null && command -v kubectl >/dev/null; then :; \
	elif command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
		echo 'Installing HAProxy and kubectl for the tests of several replicas.' >&2; \
		apt-get update -qq >/dev/null 2>&1; \
		for each in haproxy kubectl:kubernetes-client; do \
			command -v "$${each%%:*}" >/dev/null || DEBIAN_FRONTEND=noninteractive apt-get install \
				-qq --yes --no-install-recommends "$${each##*:}" >/dev/null 2>&1 \
				|| echo "$${each##*:} cannot be installed: its tests are skipped." >&2; \
		done; \
	else echo 'There is no HAProxy, or no kubectl: the tests of several replicas are skipped.' >&2; fi

# As above: tests that find no promtool are skipped.
promtool:
	@if command -v promtool >/dev/null; then :; \
	elif command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
		echo 'Installing Prometheus, whose promtool tests the alerts.' >&2; \
		apt-get update -qq >/dev/null 2>&1; \
		DEBIAN_FRONTEND=noninteractive apt-get install -qq --yes --no-install-recommends prometheus \
			>/dev/null 2>&1 || echo 'It cannot be installed: those tests are skipped.' >&2; \
	else echo 'There is no promtool: the tests of the alerts are skipped.' >&2; fi

demo: install ## the main job on a synthetic sample: build, serve, localize, picture
	$(BIN)/python examples/demo.py

test: test-core test-extensions ## the tests, in about half an hour on two cores

test-core: develop browser balancer promtool ## the core's tests, in a copy without extensions
	$(BIN)/python -m tools.apart --all --only tests

test-extensions: develop ## the tests of the extensions, and of what the docs say
	$(BIN)/pytest -m 'not slow' --numprocesses 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 1 \
		visloc_extensions tests/test_docs.py

test-slow: develop browser balancer promtool ## the slow tests
	$(BIN)/pytest -m slow

apart: develop ## the core's checks and tests without each extension in turn: NAMES
	$(BIN)/python -m tools.apart $(NAMES) $(ARGS)

size: develop ## lines by room of the core and by extension, against pyproject.toml
	$(BIN)/python -m tools.size

docs-check: develop ## run the commands that the docs print, or parse those that take hours: PAGES
	$(BIN)/python -m tests.docs_check $(PAGES)

site: develop ## write the documentation as a site to .site, with warnings as errors
	PYTHONPATH=. $(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -c tools/site . .site

docs-links: develop ## ask the hosts that the documentation links to
	PYTHONPATH=. $(BIN)/sphinx-build --quiet -b linkcheck -c tools/site . .site-links

docs-errors: develop ## write the tables of error codes from visloc/error_codes.toml
	$(BIN)/python -m tests.error_docs

docs-options: develop ## write the table of options from visloc/options.py
	$(BIN)/python -m tests.option_docs

licences: develop ## write docs/licences.md, and check it against tools/supply_chain/policy.toml
	$(BIN)/python -m tools.supply_chain.licences --write

lock: develop ## write docker/locks from constraints.txt, with the hashes of the package index
	$(BIN)/python -m tools.supply_chain.lock

# What an image holds: its lock, and torch, which no lock has.
define held_by
{ cat docker/locks/$$image.txt; test $$image = clients || grep '^torch==' constraints.txt; }
endef

sbom: develop ## write .sbom/IMAGE.cdx.json (CycloneDX): what each image holds
	mkdir -p .sbom
	for image in service mapping clients; do $(held_by) | PYTHONWARNINGS=ignore $(BIN)/cyclonedx-py \
		requirements --pyproject pyproject.toml --output-reproducible --output-file .sbom/$$image.cdx.json - \
		|| exit 1; done

audit: develop ## known vulnerabilities of what the images hold; fails too where PyPI does not tell
	mkdir -p .sbom
	for image in service mapping clients; do $(held_by) | sed 's/ --hash.*//' > .sbom/$$image.txt; \
		$(BIN)/pip-audit --strict --no-deps --disable-pip --requirement .sbom/$$image.txt || exit 1; done

fuzz: develop ## fuzz what reads strangers' bytes: RUNS inputs for each target
	$(BIN)/python -m tests.fuzz --runs $(or $(RUNS),100000)

fuzz-api: develop ## send CASES requests made from our OpenAPI
	$(BIN)/python -m tests.fuzz.api --cases $(or $(CASES),5000)

train-smoke: develop ## train 20 steps on the sample: the loss falls
	$(BIN)/pytest visloc_extensions/training/tests/test_training_run.py -k twenty_steps

bench: develop ## seconds and accuracy beside the peer and the machine's limit, of DATASET with FEATURES
	$(BIN)/python -m benchmarks.speed $(or $(DATASET),../shared/data/redkitchen) \
		--local-features $(or $(FEATURES),faster2d2) --weights-dir $(or $(WEIGHTS),../shared/weights) $(ARGS)

bench-gpu: develop ## networks, queries and a service on a CUDA GPU, of DATASET
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.speed.gpu $(or $(DATASET),../shared/data/redkitchen) \
		--weights-dir $(or $(WEIGHTS),../shared/weights) $(ARGS)

bench-scale: develop ## maps of 100 to 100 000 images: opening, memory, retrieval
	$(BIN)/python -m benchmarks.scale $(ARGS)

bench-change: develop ## other light, weather and cameras: where photos are lost, as in docs/change.md
	$(BIN)/python -m benchmarks.change $(ARGS)

results: develop ## measure tables of docs/results.md, or ONLY these, and stamp them; goes on where it stopped
	nice -n 5 $(BIN)/python -m benchmarks.results $(ONLY) $(ARGS)

trust: develop ## how far an answer can be trusted: every figure of docs/trust.md
	$(BIN)/python -m benchmarks.trust $(ARGS)

fmt: develop ## format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lint: develop ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: develop ## mypy, strict
	$(BIN)/mypy

contracts: develop ## who may import whom
	$(BIN)/lint-imports

proto: develop ## generate visloc_api from proto/
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m grpc_tools.protoc --proto_path=proto --python_out=. --grpc_python_out=. \
		--mypy_out=. --mypy_grpc_out=. proto/visloc_api/v1/localization.proto

proto-check: proto ## the committed stubs are those of the proto
	git diff --exit-code -- visloc_api
	@test -z "$$(git status --porcelain -- visloc_api)" || (git status --short -- visloc_api; exit 1)

check-page: page ## types, format and unit tests of web/
	@if $(NODE_IS_THERE); then npm run --prefix web --silent check; \
	else echo 'The page is not checked: there is no Node.js.' >&2; fi

licences-check: develop ## dependencies have licences that the policy allows
	$(BIN)/python -m tools.supply_chain.licences

check: lint types contracts size licences-check proto-check check-page site ## what must be green before review

serve: install ## serve the maps in maps/ on 127.0.0.1:8000 (HTTP) and :50051 (gRPC)
	$(BIN)/python -m service --maps-dir maps

clean: ## remove what make made
	rm -rf $(VENV) .apart .site .site-links .sbom .demo .bench .change .results .trust web/node_modules web/client/dist service/page/built
