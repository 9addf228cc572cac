#!/bin/sh
# Draws the figures of the documentation anew from the committed results: sh docs/figures.sh
# With two run folders of driving (ppl and pvp, seed 0) the steering figure too:
# sh docs/figures.sh RUN_PPL RUN_PVP
set -eu
cd "$(dirname "$0")/.."
results=experiments/results
out=docs/pages/figures
mkdir -p "$out"
figure() { "${PYTHON:-python}" -m experiments.cli figure "$@"; }

figure $results/driving_methods.csv --out $out/driving_methods.png
figure $results/driving_confirmation.csv --out $out/driving_confirmation.png
figure $results/lift_ppl.csv --out $out/lift_ppl.png
figure $results/driving_horizon.csv --steps 5000 10000 15000 --out $out/driving_horizon.png
figure $results/table_wiping_horizon.csv --steps 2000 4000 6000 --out $out/wiping_horizon.png
figure $results/driving_horizon_measured.csv $results/driving_horizon.csv \
    --kind horizon --out $out/driving_horizon_measured.png
for study in horizon_beta prediction_noise expert_noise; do
    figure $results/driving_$study.csv --out $out/driving_$study.png
    figure $results/table_wiping_$study.csv --out $out/wiping_$study.png
done
figure $results/bench_growth.csv --out $out/growth.png
figure envs/pretrained --out $out/experts.png
if [ $# -eq 2 ]; then
    figure "$1" "$2" --kind steering --scenario 1004 --out $out/steering.png
fi
