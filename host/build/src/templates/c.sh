#!/bin/sh
# Builds a module: sh build.sh [OUT]. `bumpless build` and `bumpless dev` run this and make a component of it. Needs clang and lld.
set -eu
cd "$(dirname "$0")"
mkdir -p build
sed "s/\"0\.1\.0\"/\"${BUMPLESS_VERSION:-0.1.0}\"/" component.c > build/component.c
clang --target=wasm32-unknown-unknown -std=c11 -O2 -Wall -Wextra -Werror -Wno-unused-parameter -fno-builtin \
  -nostdlib -isystem libc -I bindings -I . -Wl,--no-entry -Wl,-z,stack-size=16384 -Wl,--strip-debug \
  build/component.c law.c libc/libc.c bindings/controller.c bindings/controller_component_type.o -o "${1:-build/module.wasm}"
