#!/usr/bin/env bash
# Makes the packed variants of tests/fixtures/blender_sparse.glb with glTF Transform; run make_fixtures_blender.py first.
#
#     npm install --prefix /tmp/npmx @gltf-transform/cli
#     PATH=/tmp/npmx/node_modules/.bin:$PATH bash tests/make_fixtures_gltf_transform.sh
set -euo pipefail
cd "$(dirname "$0")/fixtures"
for how in quantize sparse meshopt draco webp; do
  rm -f "transform_$how.glb"
  gltf-transform "$how" blender_sparse.glb "transform_$how.glb"
done
