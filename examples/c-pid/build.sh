#!/bin/sh
# Builds a component of law.c: sh build.sh [OUT]. BUILD is where the parts go. In this tree XTASK writes the bindings and makes the
# component; a copy of this folder elsewhere has the interfaces in it, as wit/, and wit-bindgen and wasm-tools do it.
set -eu
cd "$(dirname "$0")"
xtask="${XTASK:-cargo xtask}"
build="${BUILD:-$PWD/build}"
case "$build" in /*) ;; *) build="$PWD/$build" ;; esac
out="${1:-c-pid.wasm}"
case "$out" in /*) ;; *) out="$PWD/$out" ;; esac

if [ -d wit ]; then
  wit-bindgen c --world controller --out-dir "$build" wit
else
  $xtask bindings c "$build"
fi
clang --target=wasm32-unknown-unknown -std=c11 -O2 -Wall -Wextra -Werror -Wno-unused-parameter -fno-builtin \
  -nostdlib -isystem libc -I "$build" -Wl,--no-entry -Wl,-z,stack-size=16384 -Wl,--strip-debug \
  component.c law.c libc/libc.c "$build/controller.c" "$build/controller_component_type.o" -o "$build/module.wasm"
if [ -d wit ]; then
  wasm-tools component new "$build/module.wasm" -o "$out"
else
  $xtask component "$build/module.wasm" "$out"
fi
