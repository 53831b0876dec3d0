#!/usr/bin/env bash
# Makes three.min.js and three.LICENSE.txt from the npm packages below, anew. Needs npm and a network; the result is committed,
# so nobody else does.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
three=0.187.0 esbuild=0.28.2
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
cd "$work"
npm init --yes >/dev/null
npm install --no-audit --no-fund "three@$three" "esbuild@$esbuild"
cp "$here/three_entry.js" entry.js
node_modules/.bin/esbuild entry.js --bundle --minify --format=iife --global-name=THREE --target=es2020 --charset=ascii \
  --legal-comments=none --banner:js="/* three.js $three, https://threejs.org, MIT licence: see three.LICENSE.txt */" \
  --outfile="$here/three.min.js"
cp node_modules/three/LICENSE "$here/three.LICENSE.txt"
