#!/bin/sh
# Generate shared/wire/ from proto/pointslam/v1/: proto/generate.sh [OUT]
#
# The files lie flat in one package of ours, so the generated imports of the proto path
# (pointslam.v1) are turned into imports of it.
set -eu
cd "$(dirname "$0")/.."
out=${1:-shared/wire}
python=${PYTHON:-.venv/bin/python}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$python" -m grpc_tools.protoc -Iproto \
    --python_out="$work" --pyi_out="$work" --grpc_python_out="$work" \
    proto/pointslam/v1/*.proto
sed -i 's/^from pointslam\.v1 import/from shared.wire import/' "$work"/pointslam/v1/*
mkdir -p "$out"
rm -f "$out"/*_pb2*
cp "$work"/pointslam/v1/* "$out"/
