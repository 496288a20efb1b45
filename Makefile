# Everything a person does with Stria's sources. `make demo` and `make test` need only Debian 12, Rust, Node and make.
.PHONY: demo test bench bench-defects bench-exports bench-live bench-queue bench-upload check setup web build

# Sets up, builds, makes a realistic run, processes it through the server and says which URL to open.
demo: build
	docker/demo.sh

# Sets up and runs every test: unit, truth, formats, service, browser.
test: build
	cargo test --release --locked --workspace
	cd tests/browser && npm test

# Speed, memory and accuracy on this machine in one run, over simulated full HD runs; BENCH="--help" explains the rest.
bench: build
	target/python/bin/python tests/bench/bench.py $(BENCH)

# What 30 minutes cost to hand on: size, time and memory of every export of a job and of a full HD cloud; size of archives.
bench-exports: build
	target/python/bin/python tests/bench/bench.py --skip speed,memory,accuracy $(BENCH)

# A live run: frames lost, latency, the server's memory; LIVE=10 streams for ten minutes.
LIVE ?= 1
bench-live: build
	target/python/bin/python tests/bench/live.py $(LIVE)

# An upload on loopback beside a plain copy of the same file; MB=4000 sends that much.
MB ?= 1000
bench-upload: build
	target/python/bin/python tests/bench/upload.py $(MB)

# The queue beside graphile_worker on one PostgreSQL; then its times beside 10,000 and 1,000,000 jobs.
bench-queue: build
	cd tests/bench/queue && npm ci --no-audit --no-fund
	target/python/bin/python tests/bench/bench_queue.py

# Defects, sections and change between runs against the truth; DEFECTS="--quick" for three scenes.
bench-defects: build
	target/python/bin/python tests/bench/defects.py $(DEFECTS)

# Format, lints and docs as errors.
check: setup web
	cargo fmt --all --check
	cargo clippy --release --locked --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --release --locked --workspace --no-deps
	cd web && npm run generate:check

setup:
	docker/set-up.sh

web: setup
	cd web && npm ci --no-audit --no-fund && npm run build

build: setup web
	cargo build --release --locked --workspace
