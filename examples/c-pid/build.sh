#!/bin/sh
# Builds a component of law.c: sh build.sh [OUT]. BUILD is where the parts go. XTASK writes the bindings and makes the component;
# outside of this tree `wit-bindgen c` and `wasm-tools component new` do the same.
set -eu
cd "$(dirname "$0")"
xtask="${XTASK:-cargo xtask}"
build="${BUILD:-$PWD/build}"
case "$build" in /*) ;; *) build="$PWD/$build" ;; esac
out="${1:-c-pid.wasm}"
case "$out" in /*) ;; *) out="$PWD/$out" ;; esac

$xtask bindings c "$build"
clang --target=wasm32-unknown-unknown -std=c11 -O2 -Wall -Wextra -Werror -Wno-unused-parameter -fno-builtin \
  -nostdlib -isystem libc -I "$build" -Wl,--no-entry -Wl,-z,stack-size=16384 -Wl,--strip-debug \
  component.c law.c libc/libc.c "$build/controller.c" "$build/controller_component_type.o" -o "$build/module.wasm"
$xtask component "$build/module.wasm" "$out"
