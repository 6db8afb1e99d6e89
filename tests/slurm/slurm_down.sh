#!/usr/bin/env bash
# Stop only what slurm_up.sh started (by recorded pid).
ROOT=${SLURM_IT:-${TMPDIR:-/tmp}/slurm-it}
export SLURM_CONF="$ROOT/etc/slurm.conf"
timeout 10 scancel -u "$(id -un)" 2>/dev/null || true; sleep 1
for d in slurmd slurmctld munged; do
  p="$ROOT/run/$d.pid"; [ -s "$p" ] && kill "$(cat "$p")" 2>/dev/null || true
done
