#!/bin/sh
# A night's job: run on what was recorded in the last days, once, and export the tables of all logs.
#
#   nightly.sh FOLDER [DAYS]
#
# FOLDER/recordings has the logs, in folders of any depth. FOLDER gets the ledgers, tables/, and nightly.log with a line
# of JSON for each note. The exit code is the worst of the two commands: 0, or 3 if some logs failed, which are tried
# again the next night. Two of these at once, also on two machines that share FOLDER, share the work.
#
# MCAPTRACK names the program, by default that of the image (see Dockerfile); JOBS how many logs are processed at once,
# and MCAPTRACK_MAX_WORKER_MB how much memory a log may take.
set -u
cd "$1" || exit 1
: "${JOBS:=2}"
export MCAPTRACK_MAX_WORKER_MB="${MCAPTRACK_MAX_WORKER_MB:-8000}"
: "${MCAPTRACK:=docker run --rm --interactive --user $(id -u):$(id -g) --volume $PWD:/data --env MCAPTRACK_MAX_WORKER_MB mcaptrack}"

find recordings -name '*.mcap' ! -name '*.results.mcap' -mtime "-${2:-2}" -print0 |
    $MCAPTRACK run - --jobs "$JOBS" --timeout 1h --ledger run.jsonl --log-format json 2>> nightly.log
ran=$?
$MCAPTRACK export recordings/ --output tables/ --jobs "$JOBS" --ledger export.jsonl --log-format json 2>> nightly.log
exported=$?
[ "$ran" -gt "$exported" ] && exit "$ran"
exit "$exported"
