#!/usr/bin/env bash
# Run the workflow for one dataset and name the report: workflow/run.sh DATASET CORES [ARGS...]
set -euo pipefail
dataset=$1
cores=$2
shift 2
# A killed run leaves its lock behind. Nobody else works here if no process holds the folder's lock.
mkdir -p results
exec 9>results/.run.lock
# Jobs of a killed run hold it too until the kernel has buried them, hence the patience.
if ! flock --timeout "${NTOP_LOCK_WAIT_S:-30}" 9; then
  echo "ntop: another run works in $PWD; wait for it, or stop it first" >&2
  exit 1
fi
snakemake --unlock --cores "$cores" --quiet all "$@" >/dev/null
snakemake --cores "$cores" --quiet progress "$@"
echo
echo "dataset: $PWD/results/7_assemble/$dataset"
echo "report:  $PWD/results/8_evaluate/$dataset/report.html"
