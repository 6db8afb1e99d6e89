#!/usr/bin/env bash
# Stop only what slurm_up.sh started (by recorded pid), and wait until it is gone.
ROOT=${SLURM_IT:-${TMPDIR:-/tmp}/slurm-it}
export SLURM_CONF="$ROOT/etc/slurm.conf"
timeout 10 scancel -u "$(id -un)" 2>/dev/null || true; sleep 1
for d in slurmd slurmctld munged; do
  [ -s "$ROOT/run/$d.pid" ] || continue
  pid=$(cat "$ROOT/run/$d.pid")
  kill "$pid" 2>/dev/null || true
  for _ in $(seq 50); do kill -0 "$pid" 2>/dev/null || break; sleep 0.1; done
done
