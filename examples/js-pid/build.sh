#!/bin/sh
# Builds a component of law.js: sh build.sh [OUT]. TOOLS names the folder with componentize-qjs where npm installed elsewhere. A copy
# of this folder elsewhere has the interfaces in it, as wit/.
set -eu
cd "$(dirname "$0")"
wit=../../wit
if [ -d wit ]; then wit=wit; fi
PATH="${TOOLS:-$PWD/node_modules/.bin}:$PATH"
# QuickJS with its libc asks for WASI, and a controller has no operating system: --stub-wasi puts traps in its place.
# --sync: the host calls without the component model's async.
componentize-qjs --wit "$wit" --world controller --sync --stub-wasi --js law.js --output "${1:-js-pid.wasm}"
