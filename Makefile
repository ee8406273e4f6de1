# What a person types. Everything runs from the repository and cleans up after itself.

# Appended to PATH, so that nobody's own programs are hidden.
WITH_MOSQUITTO = tools=$$(scripts/get-mosquitto) && PATH="$$PATH:$$tools"

.PHONY: demo test test-page test-wireshark test-openmetrics test-home-assistant lint goldens bench soak

# The whole program without hardware: simulated devices, a broker, the gateway. Ctrl-C ends it.
demo:
	@$(WITH_MOSQUITTO) exec cargo run --locked -- demo

# Every test that needs no large download. The program is built first as `make demo` builds it (without
# what only tests need), so that the test of `make demo` waits for the demo and not for the compiler.
test:
	@$(WITH_MOSQUITTO) && cargo build --locked && exec cargo test --locked

# The status page in a real Chromium, which is installed where it is missing. Pictures go to target/page.
test-page:
	@$(WITH_MOSQUITTO) && exec tests/page/run

# What Wireshark makes of recordings; tshark (128 MB) is installed where it is missing.
test-wireshark:
	@$(WITH_MOSQUITTO) && tshark=$$(scripts/get-tshark) && PATH="$$PATH:$$tshark" \
		exec cargo test --locked --test line wireshark -- --include-ignored

# What Prometheus's own strict reader makes of /metrics; it is fetched from PyPI into target.
test-openmetrics:
	@$(WITH_MOSQUITTO) && BUSKER_OPENMETRICS_PYTHON="$$(scripts/get-openmetrics-reader)" \
		exec cargo test --locked --test field strict_reader -- --include-ignored

# The discovery messages against a real Home Assistant core; downloads about 800 MB the first time.
test-home-assistant:
	@$(WITH_MOSQUITTO) exec tests/home-assistant/run $(VERSION)

lint:
	cargo fmt --check
	cargo clippy --locked --all-targets -- -D warnings

# Rewrites the goldens, the messages of faulty files, the schemas and the pages of docs/devices from
# what the program does now.
# Read the difference before committing it.
goldens:
	@$(WITH_MOSQUITTO) && BLESS=1 exec cargo test --locked

# The release build against a paced wire, about six minutes on an otherwise idle machine; writes
# docs/performance.md. `make bench ROWS=W1,W8` runs only these, `make bench QUICK=1` takes one or two minutes.
bench:
	@$(WITH_MOSQUITTO) && cargo build --locked --release --bin busker --example bench && \
		BUSKER_LIBMODBUS_LOOP="$$(scripts/get-libmodbus-loop)" \
		exec $${CARGO_TARGET_DIR:-target}/release/examples/bench $(if $(QUICK),--quick) $(if $(ROWS),--rows $(ROWS))

# A life of faults in real time, ten minutes of it: `make soak MINUTES=60 SEED=7`. Prints what was seen, and
# writes target/soak.json.
soak:
	@$(WITH_MOSQUITTO) && cargo build --locked --release --bin busker --example soak && \
		exec $${CARGO_TARGET_DIR:-target}/release/examples/soak $(if $(MINUTES),--minutes $(MINUTES)) $(if $(SEED),--seed $(SEED))
