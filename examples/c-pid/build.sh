#!/bin/sh
# Builds a component of law.c: sh build.sh [OUT]. BUILD is where the parts go. In this tree XTASK writes the bindings and makes the
# component; for a copy of this folder elsewhere WIT names the folder with the interfaces, and wit-bindgen and wasm-tools do it.
set -eu
cd "$(dirname "$0")"
xtask="${XTASK:-cargo xtask}"
build="${BUILD:-$PWD/build}"
case "$build" in /*) ;; *) build="$PWD/$build" ;; esac
out="${1:-c-pid.wasm}"
case "$out" in /*) ;; *) out="$PWD/$out" ;; esac

if [ -n "${WIT:-}" ]; then
  wit-bindgen c --world controller --out-dir "$build" "$WIT"
else
  $xtask bindings c "$build"
fi
clang --target=wasm32-unknown-unknown -std=c11 -O2 -Wall -Wextra -Werror -Wno-unused-parameter -fno-builtin \
  -nostdlib -isystem libc -I "$build" -Wl,--no-entry -Wl,-z,stack-size=16384 -Wl,--strip-debug \
  component.c law.c libc/libc.c "$build/controller.c" "$build/controller_component_type.o" -o "$build/module.wasm"
if [ -n "${WIT:-}" ]; then
  wasm-tools component new "$build/module.wasm" -o "$out"
else
  $xtask component "$build/module.wasm" "$out"
fi
