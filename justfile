# The project's commands. `just` lists them; without just, each line runs as it stands.
# The gate (.ci/run) runs: format core lints docs deny test demo.

set shell := ["bash", "-euo", "pipefail", "-c"]

# list the commands
default:
    @just --list

# everything the gate runs, in its order
gate: format core lints docs deny test demo

# formatting
format:
    cargo fmt --all --check

# the core alone: no std, no alloc, no features unified in by another crate
core:
    cargo build --release -p graspd-rt

# clippy, warnings are errors
lints:
    cargo clippy --release --workspace --all-targets -- -D warnings

# the API documentation, warnings are errors
docs:
    RUSTDOCFLAGS="-D warnings" cargo doc --release --workspace --no-deps --quiet

# licences, advisories and sources of the dependencies (cargo install cargo-deny --locked)
deny:
    if command -v cargo-deny >/dev/null; then cargo deny --offline --all-features check bans licenses sources; else echo "cargo-deny is not installed: skipped"; fi

# all tests: the README's command
test:
    cargo test --release --workspace

# one test by name: just one graspd-rt closed_loop a_stop_request
one package binary name="":
    cargo test --release -p {{package}} --test {{binary}} -- --nocapture {{name}}

# one headless demo; a host that stalls the arm past its watchdog (codes 4 and 5) may try again, a motion that does not converge may not
demo:
    out=$(mktemp -d); trap 'rm -rf "$out"' EXIT; code=0; \
    for attempt in 1 2 3; do \
      code=0; cargo run --release -- demo --headless --seed 1 --json --out "$out" || code=$?; \
      [ "$code" -eq 5 ] || [ "$code" -eq 4 ] || break; \
      echo "attempt $attempt ended with code $code"; \
    done; exit "$code"

# benchmarks of the core, the off-line stage and the link
bench:
    cargo bench -p graspd-rt
    cargo bench -p graspd-calib
    cargo bench -p graspd-hil --bench plan
    cargo bench -p graspd --bench rtde_cycle

# mutants of guard, mode and supervision that no test notices (cargo install cargo-mutants --locked)
mutants:
    cargo mutants -p graspd-rt -f 'rt/src/guard/**' -f 'rt/src/mode/**' -f 'rt/src/cycle/watch_*.rs' -- --release
