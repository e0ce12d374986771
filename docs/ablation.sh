#!/bin/sh
# The ablation of docs/reports/gelflow.md: trains every variant at equal steps and compares them.
#
#     STEPS=4000 JOBS=4 SEEDS="0 1 2" sh docs/ablation.sh TRAIN VALIDATION OUT [further options of train]
#
# TRAIN and VALIDATION are folders of pairs; several are separated by spaces inside quotes. JOBS trainings run at a time, on
# one device. A run that OUT holds is gone on with. TESTS names the folders that the variants are compared on, a comparison
# each (default: VALIDATION); ONLY names some variants; CONFIG is a TOML file in place of the preset paper. Further options
# apply to all, for instance --set 'crop_size=[192,256]' --set learning_rate=2e-4.
set -euf
train=$1 validation=$2 out=$3
shift 3
steps=${STEPS:-4000} jobs=${JOBS:-1} seeds=${SEEDS:-0}
mkdir -p "$out"

# Name and what differs from the paper's configuration.
variants='paper
no_lffm model.lffm=false
no_decomposition loss.lambda_dc=0
no_deformation loss.lambda_df=0
no_regulariser loss.lambda_dc=0 loss.lambda_df=0
uniform_weight loss.weight=floor loss.weight_floor=1.0
finest_scale_only loss.lambda_s=[1.0,0,0,0,0,0,0]
edge_aware_weight loss.weight=edge_aware
floored_weight loss.weight=floor
flow_not_normalised loss.flow_normalisation=none
lffm_unscaled model.lffm_scale=none
determinant loss.ratio=det
features_not_normalised model.normalise_features=false
judged_on_images loss.compare_at=image'

# A line per run: its folder's name, then the options.
queue=$out/queue.txt
: > "$queue"
for seed in $seeds; do
    echo "$variants" | while read -r name settings; do
        case " ${ONLY:-$name} " in *" $name "*) ;; *) continue ;; esac
        options=
        for setting in $settings; do options="$options --set $setting"; done
        echo "$name.$seed --set seed=$seed$options" >> "$queue"
    done
done

# shellcheck disable=SC2016 # expanded by the inner shell
one='
run=$1; shift
resume=
[ ! -e "$OUT/$run/state.ckpt" ] || resume=--resume
python -m gelflow train $TRAIN --validation $VALIDATION --config "$CONFIG" --steps "$STEPS" "$@" $resume --out "$OUT/$run" \
    > "$OUT/$run.log" 2>&1 && echo "$run: $(tail -1 "$OUT/$run.log")" || echo "$run: FAILED: $(tail -1 "$OUT/$run.log")"'
export OUT="$out" TRAIN="$train" VALIDATION="$validation" STEPS="$steps" CONFIG="${CONFIG:-paper}"
# xargs cuts each line into words; what is common to all runs comes first, so that a variant keeps what it sets.
common=$(for word in "$@"; do printf '%s ' "$word"; done)
while read -r run options; do echo "$run $common $options"; done < "$queue" |
    xargs -P "$jobs" -L 1 sh -c "$one" ablation

for test in ${TESTS:-$validation}; do
    set --
    while read -r run _; do
        weights=$out/$run/weights.safetensors
        [ ! -e "$weights" ] || set -- "$@" --weights "${run%.*}#${run##*.}=$weights"
    done < "$queue"
    python -m gelflow compare "$test" --methods none,dis-medium "$@" --batch 0 --out "$out/compare_$(basename "$test")"
done
