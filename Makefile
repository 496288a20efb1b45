# Everything a person does with Stria's sources. `make demo` and `make test` need only Debian 12, Rust, Node and make.
.PHONY: demo test check setup web build clean

demo: setup build
	docker/demo.sh

test: setup build
	docker/test.sh

check: setup build
	cargo fmt --all --check
	cargo clippy --release --locked --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --release --locked --workspace --no-deps

setup:
	docker/set-up.sh

web:
	cd web && npm ci --no-audit --no-fund && npm run build

build: web
	cargo build --release --locked

clean:
	rm -rf target web/dist web/node_modules
