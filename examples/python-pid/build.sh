#!/bin/sh
# Builds a component of law.py: sh build.sh [OUT]. TOOLS names the folder with componentize-py where it is not on the path, BUILD
# where the module is evaluated, which leaves byte code beside it. A copy of this folder elsewhere has the interfaces in it, as wit/.
set -eu
cd "$(dirname "$0")"
wit=../../wit
if [ -d wit ]; then wit=wit; fi
PATH="${TOOLS:+$TOOLS:}$PATH"
build="${BUILD:-build}"
mkdir -p "$build/module"
cp law.py "$build/module/law.py"
# The interpreter asks for WASI, and a controller has no operating system: --stub-wasi puts traps in its place.
componentize-py -d "$wit" -w controller componentize --stub-wasi -p "$build/module" law -o "${1:-python-pid.wasm}"
