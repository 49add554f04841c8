#!/bin/sh
# Builds a component: sh build.sh [OUT]. `bumpless build` and `bumpless dev` run this. The first time it installs what package.json names.
set -eu
cd "$(dirname "$0")"
[ -d node_modules ] || npm install --no-audit --no-fund --loglevel error
node_modules/.bin/tsc --outDir build/js
sed "s/\"0\.1\.0\"/\"${BUMPLESS_VERSION:-0.1.0}\"/" build/js/law.js > build/law.js
# QuickJS with its libc asks for WASI, and a controller has no operating system: --stub-wasi puts traps in its place.
node_modules/.bin/componentize-qjs --wit wit --world controller --sync --stub-wasi --js build/law.js --output "${1:-@WORD@.wasm}"
