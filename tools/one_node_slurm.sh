#!/bin/bash
# Makes this machine a Slurm cluster of one node, which the tests marked `slurm` run on:
#
#   sudo tools/one_node_slurm.sh          installs Debian's packages where they are missing, starts
#   sudo tools/one_node_slurm.sh stop     stops what it started; folders and packages stay
#
# The node does without cgroups, which containers and small virtual machines lack: jobs are told
# apart by their processes, and no memory limit is enforced. Jobs are accounted for in a database, as
# on most clusters, because Snakemake asks `sacct` how they ended. It writes /etc/slurm/slurm.conf
# and slurmdbd.conf, and refuses a machine on which somebody else wrote them.
set -euo pipefail

state=/var/lib/one-node-slurm
mark="# Written by one_node_slurm.sh."
database_port=33306
cluster=onenode

fail() {
    echo "one_node_slurm.sh: $1" >&2
    exit 2
}

# Waits for a command to succeed, for a minute.
await() {
    local what=$1
    shift
    for _ in $(seq 120); do
        if "$@" > /dev/null 2>&1; then
            return
        fi
        sleep 0.5
    done
    fail "$what did not start within a minute; see $state and its *.log."
}

runs() {
    [ -s "$state/$1.pid" ] && kill -0 "$(cat "$state/$1.pid")" 2> /dev/null
}

munge_works() {
    munge -n | unmunge
}

ask_database() {
    mariadb --socket="$state/database/server.sock" "$@"
}

install_packages() {
    local package missing=()
    for package in slurm-wlm slurmdbd munge mariadb-server; do
        dpkg -s "$package" > /dev/null 2>&1 || missing+=("$package")
    done
    if [ ${#missing[@]} -gt 0 ]; then
        DEBIAN_FRONTEND=noninteractive apt-get install --yes --quiet --no-install-recommends \
            "${missing[@]}"
    fi
}

write_settings() {
    local name file
    name=$(hostname -s)
    for file in slurm.conf slurmdbd.conf; do
        if [ -e "/etc/slurm/$file" ] && ! grep -qxF "$mark" "/etc/slurm/$file"; then
            fail "/etc/slurm/$file is of another Slurm; use that one, or move the file away."
        fi
    done
    cat > /etc/slurm/slurm.conf << END
$mark
ClusterName=$cluster
SlurmctldHost=$name(127.0.0.1)
SlurmUser=slurm
StateSaveLocation=$state/controller
SlurmctldPidFile=$state/slurmctld.pid
SlurmctldLogFile=$state/slurmctld.log
SlurmdSpoolDir=$state/node
SlurmdPidFile=$state/slurmd.pid
SlurmdLogFile=$state/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/linux
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
$(slurmd -C | grep ^NodeName) NodeAddr=127.0.0.1
PartitionName=one Nodes=$name Default=YES MaxTime=INFINITE State=UP
END
    # Slurm refuses this file where others can read it.
    install -m 600 -o slurm -g slurm /dev/null /etc/slurm/slurmdbd.conf
    cat > /etc/slurm/slurmdbd.conf << END
$mark
DbdHost=localhost
SlurmUser=slurm
PidFile=$state/slurmdbd.pid
LogFile=$state/slurmdbd.log
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StoragePort=$database_port
StorageUser=slurm
StoragePass=$(password)
StorageLoc=slurm_acct_db
END
}

password() {
    if [ ! -s "$state/password" ]; then
        (umask 077 && head -c 18 /dev/urandom | base64 > "$state/password")
    fi
    cat "$state/password"
}

start_database() {
    if [ ! -d "$state/database/mysql" ]; then
        mariadb-install-db --no-defaults --user=mysql --datadir="$state/database" \
            --auth-root-authentication-method=socket > /dev/null
    fi
    # A server of its own: one that the machine may have is left alone.
    mariadbd --no-defaults --user=mysql --datadir="$state/database" \
        --socket="$state/database/server.sock" --pid-file="$state/database/server.pid" \
        --bind-address=127.0.0.1 --port="$database_port" \
        < /dev/null > "$state/database.log" 2>&1 &
    disown
    await "the database" ask_database --execute "SELECT 1"
    ask_database << END
CREATE DATABASE IF NOT EXISTS slurm_acct_db;
CREATE OR REPLACE USER slurm@'127.0.0.1' IDENTIFIED BY '$(password)';
GRANT ALL ON slurm_acct_db.* TO slurm@'127.0.0.1';
END
}

start_munge() {
    install -d -o munge -g munge -m 755 /run/munge
    runuser -u munge -- munged
    await munge munge_works
}

start() {
    install_packages
    install -d -m 755 "$state"
    # Where Slurm runs as its own user, it writes its process number itself.
    install -d -o slurm -g slurm -m 755 "$state" "$state/controller"
    install -d -m 755 "$state/node"
    install -d -o mysql -g mysql -m 700 "$state/database"
    write_settings
    munge_works > /dev/null 2>&1 || start_munge
    runs database/server || start_database
    if ! runs slurmdbd; then
        runuser -u slurm -- slurmdbd
        await slurmdbd sacctmgr --noheader list cluster
    fi
    if [ -z "$(sacctmgr --noheader list cluster "$cluster")" ]; then
        sacctmgr --immediate add cluster "$cluster" > /dev/null
    fi
    runs slurmctld || runuser -u slurm -- slurmctld
    await slurmctld scontrol ping
    runs slurmd || slurmd
    await slurmd sh -c "sinfo --noheader --format %T | grep -Eq 'idle|mixed|allocated'"
    sinfo
}

stop() {
    local name
    # munge stays: others may use it, too.
    for name in slurmd slurmctld slurmdbd database/server; do
        if runs "$name"; then
            kill "$(cat "$state/$name.pid")"
        fi
    done
}

[ "$(id -u)" = 0 ] || fail "it installs packages and starts services; run it as root."
case "${1:-start}" in
    start) start ;;
    stop) stop ;;
    *) fail "expected start or stop, got $1." ;;
esac
