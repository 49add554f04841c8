#!/bin/sh
# Builds a component: sh build.sh [OUT]. `bumpless build` and `bumpless dev` run this. The first time it installs what requirements.txt
# names.
set -eu
cd "$(dirname "$0")"
if ! [ -x venv/bin/componentize-py ]; then
  python3 -m venv venv
  venv/bin/pip install --quiet --disable-pip-version-check --requirement requirements.txt
fi
mkdir -p build/module
sed "s/\"0\.1\.0\"/\"${BUMPLESS_VERSION:-0.1.0}\"/" law.py > build/module/law.py
# The interpreter asks for WASI, and a controller has no operating system: --stub-wasi puts traps in its place.
venv/bin/componentize-py -d wit -w controller componentize --stub-wasi -p build/module law -o "${1:-@WORD@.wasm}"
