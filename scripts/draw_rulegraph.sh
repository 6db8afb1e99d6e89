#!/usr/bin/env bash
# Redraw docs/images/rulegraph.svg, the picture of the rules in the README. Needs graphviz.
set -euo pipefail
cd "$(dirname "$0")/.."
snakemake --rulegraph --quiet all |
  sed 's/graph\[bgcolor=white, margin=0\]/graph[bgcolor=white, margin=0.1, rankdir=LR]/' |
  dot -Tsvg >docs/images/rulegraph.svg
