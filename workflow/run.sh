#!/usr/bin/env bash
# Run the workflow for one dataset and name the report: workflow/run.sh DATASET CORES [ARGS...]
set -euo pipefail
dataset=$1
cores=$2
shift 2
# A killed run leaves its lock behind. No other run works here if no process holds the folder's lock.
mkdir -p results
exec 9>results/.run.lock
patience=${NTOP_LOCK_WAIT_S:-30}
if ! flock --timeout "$patience" 9; then
  echo "ntop: another run works in $PWD; wait for it, or stop it first" >&2
  exit 1
fi
# Jobs do not hold that lock: those of a killed run would be started twice, beside themselves. The
# patience is for those that the kernel has yet to bury.
until left=$(ntop orphans); do
  if ((SECONDS >= patience)); then
    echo "$left" >&2
    exit 1
  fi
  sleep 1
done
snakemake --unlock --cores "$cores" --quiet all "$@" >/dev/null
# Snakemake counts jobs; this says every minute how fast the stages are and how long they will take.
# It does not hold the lock, and ends with this script.
files=() takes_files=false
for word in "$@"; do
  case $word in
    --configfile | --configfiles) takes_files=true ;;
    -*) takes_files=false ;;
    *) if $takes_files; then files=("${files[@]:---configfile}" "$word"); fi ;;
  esac
done
ntop status "${files[@]}" --every-s "${NTOP_PROGRESS_S:-60}" 9>&- &
trap 'kill $! 2>/dev/null || true' EXIT
if ! snakemake --cores "$cores" --quiet progress "$@"; then
  # what Snakemake itself stumbles over it names without a word about what to do
  stuck=$(find results logs -type d ! -writable -print -quit 2>/dev/null || true)
  if [[ -n $stuck ]]; then
    echo "ntop: cannot write $stuck: Read-only file system, or another user's folder; check the" \
      "mount and the permissions, then run the same command again" >&2
  fi
  ahead=$(find results -newermt "now + 1 minute" -print -quit 2>/dev/null || true)
  if [[ -n $ahead ]]; then
    echo "ntop: $ahead was written in the future: a clock is or was wrong. If it is right now, give" \
      "such files one time that is not ahead, then run the same command again:" >&2
    echo "  find results -newermt now -exec touch --date '$(date '+%F %T')' {} +" >&2
  fi
  exit 1
fi
echo
echo "dataset: $PWD/results/7_assemble/$dataset"
echo "report:  $PWD/results/8_evaluate/$dataset/report.html"
