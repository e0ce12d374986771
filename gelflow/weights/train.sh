#!/usr/bin/env bash
# Trains weights as the shipped ones were, on NVIDIA GPUs: bash gelflow/weights/train.sh CLIPS OUT
#
# CLIPS is a folder of videos of a real gel. DEVICES is the number of GPUs of the fifth and sixth stage, PAIRS that of
# pairs of a scene in the first. The first four stages of the shipped weights used the scenes of version 0.1.0. In the
# tenth, time was over after 2,577 steps; the eleventh had 3,000, both on 1,338 pairs of fine/.
set -euo pipefail
clips=$1 out=$2 devices=${DEVICES:-1} n=${PAIRS:-900} here=$(cd "$(dirname "$0")" && pwd)
others="densetact fingervision gelsight gelsight_fingertip gelslim gelstereo omnitact tac3d"

pairs() { # NAME SCENE N SEED PAIRS_PER_TRAJECTORY, further options
    local name=$1 scene=$2 n=$3 seed=$4 per=$5
    python -m synth generate --scene "$scene" --n "$n" --seed "$seed" --device cuda --set outputs.backward=false \
        --set 'sensor.further_cameras=[]' --set sampling.pairs_per_trajectory="$per" "${@:6}" --out "$out/$name"
}

finetune() { # NAME FROM STEPS LEARNING_RATE WARMUP_STEPS SEED, folders of pairs and further options
    python -m gelflow finetune "${@:7}" --config real \
        --weights "$out/$2/weights.safetensors" $network --set ema_decay=0.999 --steps "$3" \
        --set learning_rate="$4" --set warmup_steps="$5" --set seed="$6" --out "$out/$1"
}

denoise() { # NAME FROM STEPS SEED COMPRESSION, folders of pairs and options: the denoiser alone, without added motion
    python -m gelflow finetune "${@:6}" --config real --weights "$out/$2/weights.safetensors" $network --steps "$3" \
        --set supervision=registered --set model.denoise=true --set motion.shift_px=0 --set motion.turn_deg=0 \
        --set motion.zoom=0 --set ema_decay=0.999 --set learning_rate=1e-3 --set warmup_steps=200 --set seed="$4" \
        --set compression="$5" --out "$out/$1"
}

everything() { # FOLDER SEED: pairs of all scenes
    local scene
    for scene in allsight deltact densetact dmtac fingervision gelsight gelsight_fingertip gelslim gelstereo omnitact \
        soft_bubble tac3d tac3d_single "$here/any_pattern.toml" "$here/any_round.toml"; do
        pairs "$1/$(basename "$scene" .toml)" "$scene" $((n * 5 / 9)) "$2" 5 $together
    done
    pairs "$1"/gelsight_mini gelsight_mini $((n * 5 / 2)) "$2" 5 $together
    pairs "$1"/objects objects $((n * 4 / 3)) "$2" 5 $together
    pairs "$1"/digit digit $((n * 5 / 3)) "$2" 5 $together
    pairs "$1"/turned "$here/gelsight_mini_far.toml" "$n" "$2" 5 $together $turned
}

fine() { # FOLDER SEED: pairs of sparse marks, each on a mesh of its own that meets the target, by the direct solver
    local scene
    for scene in gelslim gelsight_fingertip fingervision tac3d tac3d_single gelsight_mini gelstereo; do
        pairs "$1/$scene" "$scene" $((n * 2 / 3)) "$2" 6 $finely=0.2
    done
    pairs "$1"/any_pattern "$here/any_pattern.toml" $((n * 2 / 3)) "$2" 6 $finely=0.4
    for scene in deltact digit; do
        pairs "$1/$scene" "$scene" $((n / 3)) "$2" 6 $finely=0.5
    done
}

together="--workers 3 --set numerics.solver=batched"
finely="--set numerics.solver=single --set numerics.target_error_px"
turned="--set motion.twist_deg={uniform=[-45.0,45.0]}"
network="--device cuda --set precision=bf16 --set batch_size=16 --set crop_size=[240,320]"

python -m gelflow pairs "$clips" --min-motion 6 --per-video 8 --tries 80 --out "$out/real"
for scene in deltact soft_bubble gelsight_mini digit $others; do
    pairs "first/$scene" "$scene" "$n" 11 6 --set numerics.target_error_px=2.5
done
pairs far "$here/gelsight_mini_far.toml" "$n" 11 6 --set numerics.target_error_px=2.5
pairs turned "$here/gelsight_mini_far.toml" $((n * 5 / 3)) 32 6 $together $turned
pairs bare digit $((n * 5)) 31 6 $together
for scene in $others; do pairs "few/$scene" "$scene" $((n * 2 / 9)) 21 6; done
everything all 41
everything again 43
n=250 everything fresh 97
n=285 everything more 101
n=255 everything most 103
fine fine 107

two="$out/first/deltact $out/first/soft_bubble"
python -m gelflow train "$out"/first/* "$out/far" --config best $network \
    --set learning_rate=5e-4 --set warmup_steps=661 --steps 13220 --out "$out/1"
finetune 2 1 5301 1e-4 265 0 "$out/real" "$out/far" $two "$out/first/gelsight_mini"
finetune 3 2 15062 3e-4 265 0 "$out/real" "$out/far" $two "$out"/few/* "$out/bare"
finetune 4 3 9646 2e-4 192 1 "$out/real" "$out/far" "$out/turned" $two "$out"/few/* "$out/bare"
finetune 5 4 8157 3e-4 300 2 "$out/real" "$out"/all/* --devices "$devices"
finetune 6 5 8500 3e-4 300 3 "$out/real" "$out"/again/* --devices "$devices"
denoise 7 6 4300 0 0 "$out"/fresh/*
denoise 8 7 5800 5 0 "$out"/more/*
denoise 9 8 5000 5 0.0625 "$out"/most/*
finetune 10 9 3600 2e-4 100 4 "$out/real" "$out"/fine/* --set specks=0.5 --set compression=0.03125
denoise 11 10 3000 6 0.0625 "$out"/fine/* --set specks=0.5

# Three parts of the eleventh and one of the ninth err less on pairs of all scenes and on real ones than either.
mkdir -p "$out/12"
python - "$out"/{9,11,12}/weights.safetensors <<'PY'
import sys

from safetensors import safe_open
from safetensors.torch import save_file

with safe_open(sys.argv[1], "pt") as ninth, safe_open(sys.argv[2], "pt") as eleventh:
    mixed = {name: ninth.get_tensor(name).lerp(eleventh.get_tensor(name), 0.75) for name in eleventh.keys()}
    save_file(mixed, sys.argv[3], eleventh.metadata())
PY
