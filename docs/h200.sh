#!/bin/sh
# Most measurements of docs/reports/h200.md on one GPU: sh docs/h200.sh OUT [PAIRS [REAL]]
#
# PAIRS is a folder of folders of pairs (docs/test_set.sh), REAL one of real pairs: for the times of `compare`, left out without them.
# Each part writes its log or table into OUT; a part that OUT holds is not run again. CORES (default 0-15) are
# the cores that generate may use, SHARDS (default "4:3 2:7") processes on the GPU and workers of each; the data go to /dev/shm.
set -eu
out=$1 pairs=${2:-} real=${3:-}
mkdir -p "$out"

part() { # file, command
    file=$out/$1
    shift
    [ -s "$file" ] || "$@" > "$file" 2> "$file.err" || echo "failed: $* (see $file.err)"
}

shards() { # processes, workers: 1,000 pairs; a line a second: seconds, pairs that are there
    data=/dev/shm/shards_$1 began=$(date +%s) running=
    for i in $(seq 0 $(($1 - 1))); do
        taskset -c "${CORES:-0-15}" python -m synth generate --scene gelsight_mini --n "${N:-1000}" --seed 5 --shard "$i/$1" --workers "$2" \
            --device cuda --set numerics.solver=batched --set sensor.camera.width=640 --set sensor.camera.height=480 \
            --set sensor.camera.fx=900.4 --set sensor.camera.fy=900.4 --set 'sensor.camera.cx={normal=[320.0,6.0]}' \
            --set 'sensor.camera.cy={normal=[240.0,6.0]}' --set render.samples_per_pixel=64 --set 'render.light="path_traced"' \
            --json --out "$data" > "$out/shard_$1_$i.json" &
        running="$running $!"
    done
    for process in $running; do
        while kill -0 "$process" 2>/dev/null; do
            echo "$(($(date +%s) - began)) $(find "$data/samples" -mindepth 1 -maxdepth 1 -name '[0-9]*' 2>/dev/null | wc -l)"
            sleep 1
        done
    done
    wait
    du -sm "$data"
    rm -rf "$data"
}

presses="python -m benchmarks batched --cells 16 12 2 --growth 2.5 --radii 3 6 --step 0.334 --closer 0.1 --out $out"
# shellcheck disable=SC2086 # several words
{
    part presses_fast.log $presses --forcing 0.03 --loose 1e-2 --batch 1024 2048 --runs 2
    part presses_tight.log $presses --forcing 0.03 --batch 1024 2048
    part presses.log $presses --batch 1024
}
for each in ${SHARDS:-4:3 2:7}; do part "shards_${each%:*}.log" shards "${each%:*}" "${each#*:}"; done
agreement="python -m benchmarks agreement --processes ${PROCESSES:-16} --out $out"
# shellcheck disable=SC2086 # several words
for mesh in 6x4x2:256 10x8x2:128 16x12x2:64; do
    cells=${mesh%:*}
    part "agreement_$cells.log" $agreement --cells $(echo "$cells" | tr x ' ') --trajectories "${mesh#*:}"
done
# shellcheck disable=SC2086 # several words
part agreement_failing.log $agreement --trajectories 64 \
    --set motion.depth_mm=2.6 --set contact.friction=1.2 --set motion.twist_deg=40
part cuda_tests.log python -m pytest -m cuda
R="--device cuda --methods none --weights best --registration none --registration motion --registration both --registration brightness"
# shellcheck disable=SC2086 # several words
[ -z "$real" ] || for batch in 1 16; do part "times_$batch.log" python -m gelflow compare "$real" $R --batch "$batch" --out "$out/times_$batch"; done
# shellcheck disable=SC2086 # several words
[ -z "$pairs" ] || part times_sizes.log python -m gelflow compare "$pairs"/* $R --batch 0 --out "$out/times_sizes"
