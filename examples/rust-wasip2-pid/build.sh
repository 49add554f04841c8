#!/bin/sh
# Builds a component with plain cargo: sh build.sh [OUT]. BUILD is where the parts go.
set -eu
cd "$(dirname "$0")"
xtask="${XTASK:-cargo xtask}"
build="${BUILD:-$PWD/build}"
out="${1:-rust-wasip2-pid.wasm}"
case "$out" in /*) ;; *) out="$PWD/$out" ;; esac

# The standard library asks for WASI: to write a panic's words, to read the environment. Left to itself the linker makes a
# component that imports it, and a host refuses that. So it stops at the module, and traps are put in WASI's place.
cargo build --quiet --target wasm32-wasip2 --profile component \
  --config 'target.wasm32-wasip2.rustflags=["-Clink-arg=--skip-wit-component"]'
mkdir -p "$build"
cp "${CARGO_TARGET_DIR:-../../target}/wasm32-wasip2/component/rust_wasip2_pid.wasm" "$build/module.wasm"
$xtask component --stub-wasi "$build/module.wasm" "$out"
