#!/usr/bin/env bash
# Bring up a throw-away single-node SLURM (munged + slurmctld + slurmd) on 127.0.0.1, with fake GPUs.
# Everything lives under $SLURM_IT (default ${TMPDIR:-/tmp}/slurm-it); pids are in $SLURM_IT/run/*.pid.
# Verified: Debian 12, slurm-wlm 22.05.8, running as root, no systemd, no cgroup use.
set -euo pipefail
ROOT=${SLURM_IT:-${TMPDIR:-/tmp}/slurm-it}
NGPU=${NGPU:-2}
CTLD_PORT=${CTLD_PORT:-26817}; SLURMD_PORT=${SLURMD_PORT:-26818}
ME=$(id -un); HOST=$(hostname -s)
CPUS=${CPUS:-8}                          # advertised, may exceed nproc (config_overrides)
REALMEM=$(slurmd -C | sed -n 's/.*RealMemory=\([0-9]*\).*/\1/p')
MEM=${MEM:-$(( REALMEM * 8 / 10 ))}

mkdir -p "$ROOT"/{etc,run,log,spool/ctld,spool/slurmd,dev,munge}
chmod 755 "$ROOT" "$ROOT"/run; chmod 700 "$ROOT"/munge

# --- munge -----------------------------------------------------------------
if [ ! -s "$ROOT/munge/munge.key" ]; then
  dd if=/dev/urandom of="$ROOT/munge/munge.key" bs=1024 count=1 status=none
  chmod 600 "$ROOT/munge/munge.key"
fi
munged --key-file="$ROOT/munge/munge.key" --socket="$ROOT/run/munge.socket" \
       --pid-file="$ROOT/run/munged.pid" --log-file="$ROOT/log/munged.log" \
       --seed-file="$ROOT/munge/munged.seed" --num-threads=2
munge -S "$ROOT/run/munge.socket" -n | unmunge -S "$ROOT/run/munge.socket" >/dev/null

# --- fake GPU device files --------------------------------------------------
# slurmd insists on real character devices; root can mknod clones of /dev/null, others borrow /dev/ttyN
if [ "$(id -u)" = 0 ]; then
  for i in $(seq 0 $((NGPU-1))); do [ -e "$ROOT/dev/nvidia$i" ] || mknod "$ROOT/dev/nvidia$i" c 1 3; done
  GPU_FILES="$ROOT/dev/nvidia[0-$((NGPU-1))]"
else
  GPU_FILES="/dev/tty[0-$((NGPU-1))]"
fi

# cred_expire: so long a requeued job waits (120 s unless told)
cat > "$ROOT/etc/slurm.conf" <<CONF
ClusterName=it
SlurmctldHost=$HOST(127.0.0.1)
SlurmctldPort=$CTLD_PORT
SlurmdPort=$SLURMD_PORT
SlurmUser=$ME
SlurmdUser=$ME
AuthType=auth/munge
AuthInfo=socket=$ROOT/run/munge.socket,cred_expire=5
CredType=cred/munge
StateSaveLocation=$ROOT/spool/ctld
SlurmdSpoolDir=$ROOT/spool/slurmd
SlurmctldPidFile=$ROOT/run/slurmctld.pid
SlurmdPidFile=$ROOT/run/slurmd.pid
SlurmctldLogFile=$ROOT/log/slurmctld.log
SlurmdLogFile=$ROOT/log/slurmd.log
SlurmctldDebug=info
SlurmdDebug=info
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=5
SwitchType=switch/none
MpiDefault=none
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
ReturnToService=2
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=1,bf_interval=2,batch_sched_delay=0,sched_min_interval=100000
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
JobRequeue=1
KillWait=5
MinJobAge=600
MaxArraySize=1001
MaxJobCount=20000
GresTypes=gpu
AccountingStorageType=accounting_storage/none
NodeName=$HOST NodeAddr=127.0.0.1 Port=$SLURMD_PORT CPUs=$CPUS RealMemory=$MEM Gres=gpu:fake:$NGPU State=UNKNOWN
PartitionName=cpu  Nodes=$HOST Default=YES MaxTime=24:00:00 State=UP PriorityTier=1
PartitionName=gpu  Nodes=$HOST Default=NO  MaxTime=48:00:00 State=UP PriorityTier=1
PartitionName=urgent Nodes=$HOST Default=NO MaxTime=1:00:00 State=UP PriorityTier=10 PreemptMode=off
CONF
cat > "$ROOT/etc/gres.conf" <<CONF
AutoDetect=off
NodeName=$HOST Name=gpu Type=fake File=$GPU_FILES
CONF
cat > "$ROOT/etc/cgroup.conf" <<CONF
CgroupAutomount=no
ConstrainDevices=no
CONF
export SLURM_CONF="$ROOT/etc/slurm.conf"

# snakemake-executor-plugin-slurm-jobstep (0.6.1) strips every SLURM_* variable, SLURM_CONF
# included, before its inner `srun`; so a private slurm.conf needs a shim (or /etc/slurm/slurm.conf).
mkdir -p "$ROOT/bin"
printf '#!/bin/sh\nexport SLURM_CONF=%s\nexec /usr/bin/srun "$@"\n' "$SLURM_CONF" > "$ROOT/bin/srun"
chmod +x "$ROOT/bin/srun"
cat > "$ROOT/env.sh" <<ENV
export SLURM_CONF=$SLURM_CONF
export PATH=$ROOT/bin:\$PATH
ENV
slurmctld -f "$SLURM_CONF"
slurmd    -f "$SLURM_CONF" -N "$HOST"
for _ in $(seq 60); do
  sinfo -h -o '%T' 2>/dev/null | grep -qx idle && break; sleep 0.5
done
sinfo -N -o '%N %T %c %m %G'
echo "ready: source $ROOT/env.sh"
